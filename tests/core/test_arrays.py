"""Arrays in files: reading unpickles nothing, and checks sizes first."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from freeocc3d.core.arrays import read_arrays
from freeocc3d.core.errors import MapError


def test_arrays_are_never_unpickled_and_lies_about_their_size_are_refused(tmp_path) -> None:
    np.savez(tmp_path / "a.npz", keys=np.array([{"a": 1}], dtype=object))
    with pytest.raises(MapError, match="damaged"):
        read_arrays(tmp_path / "a.npz", {})
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)})
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("keys.npy", header.getvalue() + b"\0" * 64)
    with pytest.raises(MapError, match="is not as large as its header says"):
        read_arrays(tmp_path / "b.npz", {})


def test_what_is_expected_must_be_there_and_of_its_kind(tmp_path) -> None:
    np.savez(tmp_path / "a.npz", keys=np.zeros((2, 3), np.int32))
    assert read_arrays(tmp_path / "a.npz", {"keys": ("i", 2)})["keys"].shape == (2, 3)
    for expected in ({"keys": ("f", 2)}, {"keys": ("i", 1)}, {"others": ("i", 2)}):
        with pytest.raises(MapError, match="no usable array"):
            read_arrays(tmp_path / "a.npz", expected)
    with pytest.raises(MapError, match="is missing"):
        read_arrays(tmp_path / "b.npz", {})
