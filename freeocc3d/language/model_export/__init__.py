"""Turns checkpoints into model packages: networks as ONNX, ``tokenizer.json`` and a manifest.

``freeocc3d models export`` calls it. Only ``export_checkpoint`` imports the other modules, which need torch and
transformers.
"""
