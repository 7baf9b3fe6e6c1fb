"""The types of ROS messages. Those of cameras have not changed since ROS 1, so that the definitions in bags are not
needed."""

from __future__ import annotations

import functools
from typing import Any

_ADDED = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "tf/msg/tfMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
"""Types that the package rosbags lacks -> their definitions."""


@functools.cache
def load_types(ros1: bool) -> Any:
    """The ``Typestore`` of rosbags for messages of ROS 1 or ROS 2."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, definition in _ADDED.items():
        if name not in types.fielddefs:
            types.register(get_types_from_msg(definition, name))
    return types


def deserialize(data: bytes, kind: str, ros1: bool) -> Any:
    """A message of its bytes and the name of its type; its arrays are views of the bytes. Raises anything for bytes
    that do not fit the type."""
    types, view = load_types(ros1), memoryview(data)  # of bytes, rosbags would copy all but the first
    return types.deserialize_ros1(view, kind) if ros1 else types.deserialize_cdr(view, kind)
