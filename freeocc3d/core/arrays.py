"""Writes and reads arrays in .npz files. Writing replaces the whole file. Reading unpickles nothing and checks sizes
before it allocates memory."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from .atomic_files import replace_file
from .errors import MapError

_LARGEST_ARRAY = 8 << 30


def write_arrays(path: Path, arrays: Mapping[str, Any], compressed: bool = False) -> None:
    """Write an .npz file; an existing one is replaced. Raises OSError."""
    save = np.savez_compressed if compressed else np.savez
    replace_file(path, lambda temporary: save(temporary, **arrays))


def read_arrays(path: Path, expected: Mapping[str, tuple[str, int]]) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz file.

    expected: name -> (``dtype.kind``, number of dimensions); the file must hold each of them.
    The headers give the sizes before anything is unpacked. Raises MapError.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = {
                info.filename.removesuffix(".npy"): _read_array(archive, info, path) for info in archive.infolist()
            }
    except FileNotFoundError as error:
        raise MapError(f"{path} is missing: copy the whole map folder again, or make the map again.") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise MapError(f"{path} is damaged: {error}.") from error
    for name, (kind, dimensions) in expected.items():
        if name not in arrays or arrays[name].dtype.kind != kind or arrays[name].ndim != dimensions:
            raise MapError(f"{path} is damaged: it has no usable array '{name}'.")
    return arrays


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> NDArray[Any]:
    with archive.open(info) as stream:
        version = npy.read_magic(stream)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read_header(stream)
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or size > info.file_size or size > _LARGEST_ARRAY:
            raise MapError(f"{path} is damaged: its array {info.filename} is not as large as its header says.")
    with archive.open(info) as stream:
        return np.asarray(npy.read_array(stream, allow_pickle=False))
