"""Unpacks LZFSE, after the headers of its blocks have said how much memory that takes.

Source: the block headers of Apple's lzfse (lzfse_internal.h). The package ``lzfse`` decodes; its decoder takes memory
for whatever a block turns out to hold.
"""

from __future__ import annotations

import struct
from pathlib import Path

from ...core.errors import DependencyError, FrameError

_END, _PLAIN, _LZVN, _LZFSE = b"bvx$", b"bvx-", b"bvxn", b"bvx2"
_BITS_20 = (1 << 20) - 1
_SHORTEST_MATCH = 4
_SPARE_BYTES = 64


def lzfse_size(data: bytes, source: Path) -> int:
    """How many bytes the blocks state. Raises FrameError if they do not follow one another to their end, or state more
    matches than their bytes can be made of."""
    at = total = 0
    try:
        while (magic := data[at : at + 4]) != _END:
            raw = struct.unpack_from("<I", data, at + 4)[0]
            if magic == _PLAIN:
                at += 8 + raw
            elif magic == _LZVN:
                at += 12 + struct.unpack_from("<I", data, at + 8)[0]
            elif magic == _LZFSE:
                literals, others, header = struct.unpack_from("<3Q", data, at + 8)
                if (literals >> 40 & _BITS_20) * _SHORTEST_MATCH > raw + _SPARE_BYTES:
                    break
                at += (header & 0xFFFFFFFF) + (literals >> 20 & _BITS_20) + (others >> 40 & _BITS_20)
            else:
                break
            total += raw
        else:
            return total
    except struct.error:  # the data end within a header
        pass
    raise FrameError(f"{source} is cut off, or not packed with LZFSE ({len(data)} bytes).")


def unpack_lzfse(data: bytes, source: Path, most: int) -> bytes:
    """Unpack at most ``most`` bytes. source: what the data are, for messages. Raises FrameError, DependencyError."""
    size = lzfse_size(data, source)
    if size > most:
        raise FrameError(f"{source} unpacks to {size} bytes, more than an image of this kind can have.")
    try:
        import lzfse
    except ImportError as error:
        raise DependencyError(f"{source} needs lzfse: run pip install 'freeocc3d[formats]'.") from error
    try:
        unpacked: bytes = lzfse.decompress(data)
    except (lzfse.error, MemoryError) as error:
        raise FrameError(f"{source} is damaged: it does not unpack.") from error
    if len(unpacked) != size:
        raise FrameError(f"{source} is damaged: it unpacks to {len(unpacked)} bytes instead of {size}.")
    return unpacked
