"""Reads and writes PLY files with vertices as records. The header is checked against the file's size before reading.

Source: G. Turk, The PLY Polygon File Format, 1994. Open3D's readers are not used for Gaussians, because they convert
some properties to natural units, depending on the version. plyfile is not used, because its license is the GPL.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import FreeOccError
from .regular_files import open_regular

_LONGEST_HEADER = 1 << 16
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES = {"f4": "float", "u1": "uchar", "i4": "int"}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


Element = tuple[str, int, tuple[tuple[str, ...], ...]]


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file. form: such as "binary_little_endian".  elements: (name, count, property lines, split
    into words) of each.
    length: bytes of the header."""

    form: str
    elements: tuple[Element, ...]
    length: int

    @property
    def least_bytes(self) -> int:
        """Lower bound of the elements' size. A list counts as its length field, a number in text as two characters."""
        total = 0
        for _, count, properties in self.elements:
            kinds = [line[1] if line[0] == "list" else line[0] for line in properties]
            total += count * (2 * len(kinds) if self.form == "ascii" else sum(int(_TYPES[kind][1]) for kind in kinds))
        return total


def read_ply_header(path: Path) -> PlyHeader:
    """Read the header. Raises FreeOccError: no regular file, not a PLY file, or smaller than its header states."""
    try:
        with open_regular(path) as stream:
            text, end, _ = stream.read(_LONGEST_HEADER).partition(b"end_header")
            stream.seek(len(text) + len(end))
            ending = stream.readline(3)
            size = stream.seek(0, 2)
    except OSError as error:
        raise FreeOccError(f"Cannot read {path}: {(error.strerror or str(error)).lower()}.") from error
    lines = [tuple(line.split()) for line in text.decode("latin-1").splitlines() if line.strip()]
    if not text.startswith(b"ply") or not end:
        raise FreeOccError(f"{path} is not a PLY file.")
    try:
        form, elements = _declarations(lines[1:])
    except (IndexError, ValueError) as error:
        raise FreeOccError(f"{path} is not a PLY file: its header cannot be read ({str(error)[:80]}).") from error
    header = PlyHeader(form, elements, len(text) + len(end) + len(ending))
    if header.length + header.least_bytes > size:
        raise FreeOccError(f"{path} is damaged: its header states more data than the {size} bytes of the file.")
    return header


def _declarations(lines: list[tuple[str, ...]]) -> tuple[str, tuple[Element, ...]]:
    """The form and the elements that the lines of a header declare. Raises IndexError, ValueError."""
    form, elements = "", list[tuple[str, int, list[tuple[str, ...]]]]()
    for first, *rest in lines:
        if first == "format":
            form = rest[0]
        elif first == "element":
            if not (rest[1].isascii() and rest[1].isdigit() and len(rest[1]) < 16):
                raise ValueError(" ".join(rest))
            elements.append((rest[0], int(rest[1]), []))
        elif first == "property":
            kinds = rest[1:3] if rest[0] == "list" else rest[:1]
            if not set(kinds) <= set(_TYPES) or len(rest) != (4 if rest[0] == "list" else 2):
                raise ValueError(" ".join(rest))
            elements[-1][2].append(tuple(rest))
    if not elements:
        raise ValueError("no elements")
    return form, tuple((name, count, tuple(properties)) for name, count, properties in elements)


def read_ply_vertices(path: Path, alone: bool = False) -> NDArray[np.void]:
    """(N,) vertices of a binary PLY file, as records of their properties, in the machine's byte order.

    alone: whether the file must end with the vertices. Raises FreeOccError.
    """
    header = read_ply_header(path)
    name, count, properties = header.elements[0]
    names = [line[-1] for line in properties]
    if name != "vertex" or not names or len(set(names)) < len(names):
        raise FreeOccError(f"{path} is not a PLY file whose first element is 'vertex'.")
    if header.form not in _ORDERS or any(len(line) != 2 for line in properties):
        raise FreeOccError(f"{path} is a PLY file of form '{header.form}': convert it to a binary one without lists.")
    if not count:
        raise FreeOccError(f"{path} is damaged or empty: its header states 0 vertices.")
    dtype = np.dtype([(name, _ORDERS[header.form] + _TYPES[kind]) for kind, name in properties])
    with open_regular(path) as stream:
        stream.seek(header.length)
        rows = np.fromfile(stream, dtype, count)
        longer = alone and bool(stream.read(1))
    if len(rows) < count or longer:
        raise FreeOccError(f"{path} is damaged: it is not as long as its header states.")
    return rows.astype(dtype.newbyteorder("="), copy=False)


def write_ply(
    path: Path, vertices: NDArray[np.void], quads: NDArray[np.int32] | None = None, comments: Sequence[str] = ()
) -> None:
    """Write a binary little-endian PLY file of (N,) records and, if given, (Q, 4) quads of rows. Raises OSError."""
    kinds = {name: vertices.dtype[name].str[1:] for name in vertices.dtype.names or ()}
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    header += [f"element vertex {len(vertices)}", *(f"property {_NAMES[kind]} {name}" for name, kind in kinds.items())]
    if quads is not None:
        header += [f"element face {len(quads)}", "property list uchar int vertex_indices"]
    with path.open("wb") as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        stream.write(vertices.astype(vertices.dtype.newbyteorder("<"), copy=False).tobytes())
        if quads is not None:
            face = np.empty(len(quads), [("count", "u1"), ("corners", "<i4", 4)])
            face["count"], face["corners"] = 4, quads
            stream.write(face.tobytes())
