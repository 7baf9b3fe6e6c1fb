"""Makes model packages of ready-made ONNX exports, as the hub's Xenova and onnx-community hold them, without torch.

``freeocc3d models pull`` calls ``package_of_export``. Graphs are cut where their structure says so, not by names of
nodes; weights and operators stay as they are, in their own precision.
"""
