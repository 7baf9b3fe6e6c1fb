"""Checkpoints turned into model packages: networks as ONNX, ``tokenizer.json`` and a manifest.

``freeocc3d models export`` is the way in. Everything here needs torch and transformers: only ``export_checkpoint``
imports it.
"""
