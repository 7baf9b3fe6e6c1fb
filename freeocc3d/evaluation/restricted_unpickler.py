"""Reads pickles of published data sets without running them.

A pickle is a program. Here it may only build NumPy arrays of numbers and plain containers. The reader refuses
everything else.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.regular_files import check_regular, read_bytes

_LARGEST_FILE = 1 << 30
"""Largest file, bytes. EmbodiedOcc's largest grid, 200 x 220 x 90 voxels with float64 centers and int64 labels, takes
0.2 GB."""

_MOST_OPERATIONS = 1_000_000
_MOST_TUPLES = 10_000
_MOST_SHARED_TUPLES = 16
"""Most operations, tuples, and tuples that are used again. A package has some thousand operations and a few tuples. As
a key, a tuple that is nested too deep overflows the stack when it is hashed, and a tuple that uses each part twice
takes time that doubles with every level."""

_NO_TUPLE = frozenset({
    "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "STRING", "BINSTRING", "SHORT_BINSTRING",
    "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8", "EMPTY_LIST", "LIST", "EMPTY_DICT", "DICT", "EMPTY_SET",
    "FROZENSET", "GLOBAL", "STACK_GLOBAL", "REDUCE",
})  # fmt: skip
"""Operations after which the top of the stack is not a tuple."""


class RestrictedUnpickler(pickle.Unpickler):
    """Reads a pickle of NumPy arrays of numbers and plain containers, written by NumPy 1 or 2 in any protocol.

    It never calls a class or function that the pickle chooses. The few names in such a pickle stand for methods of this
    class, which check sizes before they take memory. ``load`` raises FreeOccError for refused content, and any error of
    ``pickle`` for damaged data; ``load_pickle`` turns these into FreeOccError too.
    """

    def __init__(self, data: bytes, path: Path):
        _check_operations(data, path)
        super().__init__(io.BytesIO(data))
        self.path = path
        self._array_bytes_left = self._text_left = len(data)

    def find_class(self, module: str, name: str) -> Any:
        """Returns the method that stands for a name. Raises FreeOccError for a name that arrays do not need."""
        admitted: dict[tuple[str, str], Any] = {
            ("numpy", "ndarray"): "ndarray",
            ("numpy", "dtype"): self._dtype,
            ("_codecs", "encode"): self._encode,
            ("collections", "OrderedDict"): self._ordered_dict,
        }
        for core in ("numpy._core", "numpy.core"):
            admitted[f"{core}.multiarray", "_reconstruct"] = self._reconstruct
            admitted[f"{core}.multiarray", "scalar"] = self._scalar
            admitted[f"{core}.numeric", "_frombuffer"] = self._frombuffer
        for builtins in ("builtins", "__builtin__"):
            admitted[builtins, "bytes"] = self._no_bytes
        if (module, name) not in admitted:
            raise FreeOccError(
                f"{self.path} is refused: it asks for {shorten(f'{module}.{name}')}, and a package may hold only NumPy "
                "arrays and plain values, because a pickle can run any code. Download it from its publisher again."
            )
        return admitted[module, name]

    def array(self, raw: Any, dtype: Any, shape: Any, order: str) -> NDArray[Any]:
        """Returns the array of some bytes, without a copy.

        All arrays together may not be larger than the file, because a package holds each byte once.
        """
        if not isinstance(raw, bytes | bytearray) or not isinstance(dtype, _DType) or not isinstance(shape, tuple):
            raise ValueError("an array's state has the wrong types")
        if not all(type(n) is int and n >= 0 for n in shape):
            raise ValueError(f"an array's shape is not a list of {len(shape)} counts")
        size = math.prod(shape) * dtype.dtype.itemsize
        if size != len(raw) or size > self._array_bytes_left:
            raise ValueError("an array's size differs from that of its data")
        self._array_bytes_left -= size
        if not size:
            return np.zeros(shape, dtype.dtype)
        return np.frombuffer(raw, dtype.dtype).reshape(shape, order="F" if order == "F" else "C")

    def _reconstruct(self, kind: Any, shape: Any, code: Any) -> NDArray[Any]:
        # NumPy always starts from an empty array; the array's state then fills it.
        if kind != "ndarray":
            raise ValueError("an array of another kind than ndarray")
        empty = _Array((0,), np.uint8)
        empty.unpickler = self
        return empty

    def _frombuffer(self, raw: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> NDArray[Any]:
        array = self.array(raw, dtype, shape, order)
        return array if axes is None else array.transpose(axes)

    def _scalar(self, dtype: Any, raw: Any) -> Any:
        return self.array(raw, dtype, (1,), "C")[0]

    def _dtype(self, code: Any, align: Any = False, copy: Any = False) -> _DType:
        if not isinstance(code, str) or not re.fullmatch(r"[biufSU]\d{1,6}", code):
            self.refuse_dtype(code if isinstance(code, str) else type(code).__name__)
        return _DType(np.dtype(code), self)

    def refuse_dtype(self, code: str) -> NoReturn:
        """Raises FreeOccError."""
        kind = "of Python objects" if code.startswith("O") else f"of type '{shorten(code)}'"
        raise FreeOccError(
            f"{self.path} is refused: it holds an array {kind}, and a package may hold only arrays of numbers and text."
        )

    def _encode(self, text: Any, codec: Any) -> bytes:
        # Protocols 0 to 2 have no bytes: Python 3 writes them as text.
        if not isinstance(text, str) or codec != "latin1":
            raise ValueError("bytes are not written as latin1 text")
        self._text_left -= len(text)
        if self._text_left < 0:
            raise ValueError("the same text is converted to bytes too often")
        return text.encode("latin1")

    def _no_bytes(self) -> bytes:
        return b""

    def _ordered_dict(self) -> dict[Any, Any]:
        return {}


class _DType:
    """Stands for a dtype while a pickle is read: a pickle's state could corrupt NumPy's own dtype."""

    __slots__ = ("dtype", "unpickler")

    def __init__(self, dtype: np.dtype[Any], unpickler: RestrictedUnpickler):
        self.dtype = dtype
        self.unpickler = unpickler

    def __setstate__(self, state: Any) -> None:
        _, order, subdtype, names, fields = state[:5]
        if subdtype is not None or names is not None or fields is not None:
            self.unpickler.refuse_dtype("V")
        if order not in ("<", ">", "|", "="):
            raise ValueError("a dtype has an unknown byte order")
        self.dtype = self.dtype.newbyteorder(order)


class _Array(np.ndarray[Any, Any]):
    """An array before its content is read."""

    unpickler: RestrictedUnpickler

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, is_fortran, raw = state
        # After the check of the size, NumPy fills this same array, which the pickle already refers to.
        self.unpickler.array(raw, dtype, shape, "C")
        super().__setstate__((1, shape, dtype.dtype, bool(is_fortran), raw))  # type: ignore[arg-type]
        del self.unpickler


def load_pickle(path: Path) -> object:
    """Reads a pickle of arrays and plain containers.

    Raises FreeOccError: no such file, too large, damaged, or it asks for anything else.
    """
    try:
        if check_regular(path).st_size > _LARGEST_FILE:
            raise FreeOccError(f"{path} is larger than 1 GiB, so it is not the ground truth of a scene.")
        data = read_bytes(path, _LARGEST_FILE)
    except OSError as error:
        raise FreeOccError(f"Cannot read {path}: {(error.strerror or str(error)).lower()}.") from error
    try:
        return RestrictedUnpickler(data, path).load()
    except FreeOccError:
        raise
    except Exception as error:  # Damaged data make pickle raise almost anything.
        raise FreeOccError(f"{path} is damaged or not a pickle: download it from its publisher again.") from error


def _check_operations(data: bytes, path: Path) -> None:
    """Raises FreeOccError or ValueError if a pickle's operations would take too much memory or time.

    Each operation makes one object or none, and the reader counts the bytes of arrays, so memory grows with the file.
    Objects that the pickle refers to again have numbers. Pickle keeps them in an array as long as the largest number,
    and the file chooses that number.
    """
    tuples, shared, previous = 0, 0, ""
    may_be_tuple: dict[int, bool] = {}
    for count, (operation, given, _) in enumerate(pickletools.genops(data)):
        name, argument = operation.name, cast(Any, given)
        if name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            number = len(may_be_tuple) if name == "MEMOIZE" else int(argument)
            if number > count:
                raise ValueError("an object's number exceeds the number of objects")
            may_be_tuple[number] = previous not in _NO_TUPLE
        tuples += name.startswith("TUPLE")
        shared += name == "DUP" or (name in ("GET", "BINGET", "LONG_BINGET") and may_be_tuple[int(argument)])
        if count > _MOST_OPERATIONS or tuples > _MOST_TUPLES or shared > _MOST_SHARED_TUPLES:
            raise FreeOccError(f"{path} is refused: it has more parts than a package of arrays.")
        previous = name


def shorten(text: str) -> str:
    """Returns a file's own words on one line for a message, without terminal control codes."""
    return "".join(letter for letter in " ".join(text[:200].split()) if letter.isprintable())[:100]
