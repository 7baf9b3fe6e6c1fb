"""The restricted unpickler: it returns arrays and plain values, and refuses everything else before it runs."""

import os
import pickle
import struct
import subprocess
import sys
from collections import OrderedDict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from embodiedocc_packages import one_sentence, package, write_package

from freeocc3d.core.errors import FreeOccError
from freeocc3d.evaluation.embodiedocc import load_global_package
from freeocc3d.evaluation.restricted_unpickler import load_pickle

ARRAYS = {
    "bool": np.array([[True, False]]), "u1": np.arange(5, dtype=np.uint8), "i8": np.arange(6).reshape(2, 3),
    "f4": np.linspace(0, 1, 24, dtype=np.float32).reshape(2, 3, 4), "fortran": np.asfortranarray(np.eye(3)[:2]),
    "big-endian": np.arange(4, dtype=">f8"), "empty": np.zeros((0, 3)), "zero-dimensional": np.array(2.5),
    "text": np.array(["wall", "floor"]), "strided": np.arange(10)[::3],
    "turned": np.arange(24).reshape(2, 3, 4).swapaxes(0, 1),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("core", ["numpy._core", "numpy.core"])
def test_arrays_and_plain_values_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int, core: str
) -> None:
    for module, function in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer")):
        numpys = getattr(getattr(np._core, module), function)
        monkeypatch.setattr(numpys, "__module__", f"{core}.{module}")
    plain = {"list": [1, -2.5, "a", None, True, (3, "b")], "ordered": OrderedDict(x=1, y=2), "bytes": b"\x00\xff"}
    scalars = [np.float32(2.5), np.int64(-3), np.bool_(True), np.bool_(True)]
    path = write_package(tmp_path / "package.pkl", ARRAYS | plain | {"scalars": scalars}, protocol)
    assert core.encode() in path.read_bytes()
    loaded: Any = load_pickle(path)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(loaded[name], array, err_msg=name)
        assert loaded[name].dtype.newbyteorder("=") == array.dtype.newbyteorder("=")
        assert loaded[name].shape == array.shape
    assert {key: loaded[key] for key in plain} == plain
    assert loaded["scalars"] == scalars
    assert [type(value) for value in loaded["scalars"]] == [type(value) for value in scalars]


def test_an_array_used_twice_is_one_array(tmp_path: Path) -> None:
    array = np.arange(1000)
    loaded: Any = load_pickle(write_package(tmp_path / "a.pkl", [array, array, {"again": array}]))
    assert loaded[0] is loaded[1] is loaded[2]["again"]


class Call:
    """Pickles as a call of a function."""

    def __init__(self, function: Any, *arguments: Any):
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> Any:
        return self.function, self.arguments


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize(
    ("function", "name"),
    [
        (os.system, "system"), (eval, "eval"), (exec, "exec"), (getattr, "getattr"), (partial, "functools.partial"),
        (__import__, "__import__"), (np.load, "load"), (np.fromfile, "fromfile"), (Path, "pathlib"), (set, "set"),
        (np.zeros, "zeros"), (np.lib.format.read_array, "read_array"), (subprocess.Popen, "Popen"),
        (bytearray, "bytearray"), (open, "open"),
    ],
)  # fmt: skip
def test_calls_are_refused_before_they_happen(tmp_path: Path, protocol: int, function: Any, name: str) -> None:
    with pytest.raises(FreeOccError, match=name) as error:
        load_pickle(write_package(tmp_path / "evil.pkl", {"global_labels": Call(function, "1")}, protocol))
    assert "evil.pkl" in str(error.value)
    assert one_sentence(error)


def test_nothing_of_a_refused_pickle_is_executed(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    path = write_package(tmp_path / "evil.pkl", package(extra=Call(os.system, f"touch {trace}")))
    with pytest.raises(FreeOccError, match=r"system, and a package may hold only NumPy arrays"):
        load_global_package(path)
    assert not trace.exists()


@pytest.mark.parametrize(
    "data",
    [
        b"(S'echo 1'\nios\nsystem\n.",
        b"\x80\x04\x8c\x05numpy\x8c\x0bcore.os.sys\x93.",
        b"\x80\x04\x8c\x08builtins\x8c\x0cobject.class\x93.",
        b"ctorch.storage\n_load_from_bytes\n.",
        b"ctorch._utils\n_rebuild_tensor_v2\n.",
        b"cnumpy\nmatrix\n.",
        b"c__main__\nCall\n.",
        b"\x80\x04\x8c\x03a\nbX\xe8\x03\x00\x00" + b"c\n" * 500 + b"\x93.",
    ],
)
def test_other_names_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "evil.pkl").write_bytes(data)
    with pytest.raises(FreeOccError, match="is refused: it asks for") as error:
        load_pickle(tmp_path / "evil.pkl")
    assert one_sentence(error)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize(
    ("array", "what"),
    [
        (np.array([1, "a", None], object), "Python objects"),
        (np.zeros(2, [("x", "f4"), ("o", "O")]), "of type 'V"),
        (np.array(["2020"], "M8[D]"), "of type 'M8'"),
        (np.ones(2, complex), "of type 'c16'"),
    ],
)
def test_arrays_of_other_things_than_numbers_and_text_are_refused(
    tmp_path: Path, protocol: int, array: np.ndarray, what: str
) -> None:
    with pytest.raises(FreeOccError, match=f"array of.*{what}|array {what}"):
        load_pickle(write_package(tmp_path / "a.pkl", array, protocol))


def text(value: str) -> bytes:
    """A short string in protocol 4."""
    return b"\x8c" + bytes([len(value)]) + value.encode()


def name(module: str, function: str) -> bytes:
    return text(module) + text(function) + b"\x93"


DTYPE = name("numpy", "dtype") + text("u1") + b"\x85R"
RECONSTRUCT = name("numpy._core.multiarray", "_reconstruct") + name("numpy", "ndarray") + b"K\x00\x85" + text("b")


@pytest.mark.parametrize(
    "data",
    [
        # _reconstruct is followed by a state that claims 2**40 bytes.
        RECONSTRUCT + b"\x87R(K\x01\x8a\x06" + (2**40).to_bytes(6, "little") + b"\x85" + DTYPE + b"\x89C\x01at" + b"b",
        # ndarray itself is called with a shape.
        name("numpy", "ndarray") + b"\x8a\x06" + (2**40).to_bytes(6, "little") + b"\x85R",
        # A dtype whose state has fields; NumPy's own would read out of bounds.
        DTYPE + b"(K\x03" + text("|") + b"N" + text("x") + b"\x85}K\x09K\x01K\x00tb",
        # A dtype whose state is no state; a scalar that is longer than its bytes; text in a codec that unpacks.
        DTYPE + b"Nb",
        name("numpy._core.multiarray", "scalar") + name("numpy", "dtype") + text("f8") + b"\x85RC\x01a\x86R",
        name("_codecs", "encode") + text("x") + text("zlib_codec") + b"\x86R",
        # An object gets number 2**31: 16 GiB of pickle's own memory.
        b"K\x01r" + struct.pack("<I", 2**31 - 1),
        # Lengths beyond the file.
        b"\x8e" + struct.pack("<Q", 2**40),
        b"\x8d" + struct.pack("<Q", 2**62),
        b"\x95" + struct.pack("<Q", 2**60) + b"N",
        # An array that is never filled gets plain attributes; persistent and extension objects; no object at all.
        RECONSTRUCT + b"\x87R}" + text("dtype") + b"K\x01sb",
        b"Ptorch\n",
        b"\x82\x01",
        b"",
    ],
)
def test_forged_sizes_and_states_are_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "forged.pkl"
    path.write_bytes(b"\x80\x04" + data + b".")
    with pytest.raises(FreeOccError, match=r"damaged|refused") as error:
        load_pickle(path)
    assert one_sentence(error)
    assert np.dtype("u1").itemsize == 1


def doubled(levels: int) -> bytes:
    """A tuple of two times a tuple of two times …, by reference: hashing it takes 2**levels steps."""
    return b")" + b"".join(b"\x94h" + bytes([level]) + b"\x86" for level in range(levels))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"}" + doubled(60) + b"K\x01s", "more parts"),
        (b"\x8f(" + doubled(60) + b"\x90", "more parts"),
        (b"})" + b"2\x86" * 60 + b"K\x01s", "more parts"),
        # An unfilled BUILD between a tuple and its number hides what the number stands for.
        (b"})" + b"".join(b"Nb\x94h" + bytes([level]) + b"\x86" for level in range(60)) + b"K\x01s", "more parts"),
        (b"}" + b")" + b"\x85" * 200_000 + b"K\x01s", "more parts"),
        (b"(" + b"N" * 1_100_000 + b"l", "more parts"),
        # The same text turned into bytes a thousand times.
        (b"(" + name("_codecs", "encode") + b"\x94X\x00\x00\x01\x00" + b"a" * 65536 + b"\x94" + text("latin1") + b"\x94"
         + b"h\x00h\x01h\x02\x86R" * 1000 + b"l", "damaged"),
    ],
)  # fmt: skip
def test_bombs_end_soon(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "bomb.pkl").write_bytes(b"\x80\x04" + data + b".")
    with pytest.raises(FreeOccError, match=message) as error:
        load_pickle(tmp_path / "bomb.pkl")
    assert one_sentence(error)


def test_lists_nested_by_reference_stay_references(tmp_path: Path) -> None:
    laughs: list[Any] = []
    for _ in range(100):
        laughs = [laughs, laughs]
    loaded: Any = load_pickle(write_package(tmp_path / "laughs.pkl", laughs))
    assert loaded[0] is loaded[1]
    with pytest.raises(FreeOccError, match="holds a list in place of named arrays"):
        load_global_package(tmp_path / "laughs.pkl")
    write_package(tmp_path / "laughs.pkl", package(scene_dim=[laughs, 1, 1], global_labels=laughs))
    with pytest.raises(FreeOccError, match=r"'scene_dim'.*three finite numbers"):
        load_global_package(tmp_path / "laughs.pkl")


def test_shared_constants_are_not_taken_for_a_bomb(tmp_path: Path) -> None:
    size = (60, 60, 36)
    assert load_pickle(write_package(tmp_path / "a.pkl", [size] * 4)) == [size] * 4


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_a_truncated_package_is_damaged_at_every_length(tmp_path: Path, protocol: int) -> None:
    data = pickle.dumps(package(), protocol)
    path = tmp_path / "scene.pkl"
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(FreeOccError, match=r"scene.pkl is damaged or not a pickle"):
            load_pickle(path)


def test_flipped_bytes_never_leave_the_family_of_errors(tmp_path: Path) -> None:
    data = pickle.dumps(package(), 4)
    rng = np.random.default_rng(0)
    path = tmp_path / "scene.pkl"
    for _ in range(1500):
        damaged = bytearray(data)
        for place in rng.integers(0, len(data), 2):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            load_global_package(path)
        except FreeOccError as error:
            assert "scene.pkl" in str(error)  # noqa: PT017


def test_files_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FreeOccError, match=r"Cannot read .*none.pkl: no such file"):
        load_pickle(tmp_path / "none.pkl")
    with pytest.raises(FreeOccError, match="Cannot read"):
        load_pickle(tmp_path)
    large = tmp_path / "large.pkl"
    with large.open("wb") as stream:
        stream.truncate((1 << 30) + 1)
    with pytest.raises(FreeOccError, match="larger than 1 GiB"):
        load_pickle(large)


@pytest.mark.parametrize(
    "data",
    [
        # An object gets number 2**27: 2 GiB of pickle's own memory.
        b"K\x01r" + struct.pack("<I", 2**27),
        # 16 MiB of text turned into bytes, and of bytes into arrays, a hundred times.
        b"(" + name("_codecs", "encode") + b"\x94X" + struct.pack("<I", 1 << 24) + b"a" * (1 << 24) + b"\x94"
        + text("latin1") + b"\x94" + b"h\x00h\x01h\x02\x86R" * 100 + b"l",
        b"(" + DTYPE + b"\x94B" + struct.pack("<I", 1 << 24) + b"a" * (1 << 24) + b"\x94"
        + (RECONSTRUCT + b"\x87R(K\x01J\x00\x00\x00\x01\x85h\x00\x89h\x01tb") * 100 + b"l",
    ],
)  # fmt: skip
def test_memory_grows_with_the_file_only(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "bomb.pkl").write_bytes(b"\x80\x04" + data + b".")
    code = (
        "import sys, resource; from pathlib import Path; from freeocc3d.core.errors import FreeOccError\n"
        "from freeocc3d.evaluation.restricted_unpickler import load_pickle\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "before = peak()\n"
        "try: load_pickle(Path(sys.argv[1]))\n"
        "except FreeOccError: print(peak() - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "bomb.pkl")], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 200 << 10
