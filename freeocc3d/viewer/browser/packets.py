"""Packets: a JSON document and arrays in one run of bytes, which the page reads without parsing the arrays.

Layout, little-endian: uint32 length of the header; the header, JSON ``{"meta": …, "arrays": {name: {"type", "shape",
"at"}}}``; zeros up to a multiple of 8; the arrays, each from a multiple of 8 (``at``, counted from there).
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {"uint8": "Uint8Array", "uint16": "Uint16Array", "uint32": "Uint32Array", "int8": "Int8Array",
          "int16": "Int16Array", "int32": "Int32Array", "float32": "Float32Array"}  # fmt: skip
_ALIGNED = 8


def pack(meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Returns the packet of a JSON document and named arrays. Raises KeyError for a type that a page has no array of,
    ValueError for a number in ``meta`` that is not finite."""
    described, parts, at = {}, [], 0
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        described[name] = {"type": _TYPES[array.dtype.name], "shape": list(array.shape), "at": at}
        parts += [data, bytes(-len(data) % _ALIGNED)]
        at += len(data) + (-len(data) % _ALIGNED)
    header = json.dumps({"meta": meta, "arrays": described}, separators=(",", ":"), allow_nan=False).encode()
    return b"".join((np.uint32(len(header)).tobytes(), header, bytes(-(len(header) + 4) % _ALIGNED), *parts))


def compress(packet: bytes, level: int = 1) -> bytes:
    """Returns a packet as gzip, the same for the same packet. level: 1 (fast) … 9 (small)."""
    return gzip.compress(packet, level, mtime=0)
