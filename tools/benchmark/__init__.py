"""Maps, ablations and the strongest peers that run here, on the same captures in one run: every figure that is claimed.

A variant is an ablation of ``configs/ablations``, a peer, or one of the measurements of ``registry.MEASUREMENTS``.
"""
