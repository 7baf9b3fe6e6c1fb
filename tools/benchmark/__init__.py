"""Maps, ablations and the strongest peers that run here, measured on the same captures in one run.

A variant is an ablation of ``configs/ablations``, a peer, or one of the measurements of ``registry.MEASUREMENTS``.
"""
