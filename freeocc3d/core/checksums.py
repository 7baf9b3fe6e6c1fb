"""Checksums of files. They tell a torn or flipped file from a whole one; they do not protect against forgery.

Source: Y. Collet, XXH3, 128 bits (xxhash.com): as fast as memory, so that a checked read costs no more than a read.
"""

from __future__ import annotations

from pathlib import Path

import xxhash

from .regular_files import open_regular

_CHUNK = 1 << 20


def hash_file(path: Path) -> str:
    """The checksum of a regular file, 32 hexadecimal digits. Raises OSError."""
    digest = xxhash.xxh3_128()
    with open_regular(path) as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def hash_bytes(data: bytes) -> str:
    """The checksum of bytes, as ``hash_file`` gives it."""
    return xxhash.xxh3_128_hexdigest(data)


def seal(text: str) -> str:
    """The text below a line with its checksum."""
    return f"{hash_bytes(text.encode())}\n{text}"


def unseal(data: bytes) -> bytes:
    """The text of ``seal``, encoded. Raises ValueError if a byte was lost or changed."""
    checksum, _, text = data.partition(b"\n")
    if checksum != hash_bytes(text).encode():
        raise ValueError("its checksum is another")
    return text
