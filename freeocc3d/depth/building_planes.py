"""The planes of a building (floors, ceilings, walls and surfaces parallel to them), and rays that meet them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit

_NEAR, _FAR, _FAR_OUTERMOST = 0.97, 1.05, 1.1  # limits of a plane's depth, times the surface's depth


@dataclass(frozen=True)
class Plane:
    """The world points X with ``normal`` · X = ``offset``, within the squares of the plane that support a surface.

    normal: (3,) float64, unit.  offset: meters.  axes: (2, 3) orthonormal, in the plane.
    square: edge of a square, meters.  support: (U, V) bool, whether each square supports a surface.
    corner: (2,) lower corner of the first square, along the axes, meters.  outermost: whether no plane of its direction
    lies farther out; such a plane extends to all squares that no ray crosses.
    """

    normal: NDArray[np.float64]
    offset: float
    axes: NDArray[np.float64]
    corner: NDArray[np.float64]
    square: float
    support: NDArray[np.bool_]
    outermost: bool


_ROWS: dict[str, tuple[str, tuple[int, ...]]] = {
    "normals": ("f", (3,)), "offsets": ("f", ()), "axes": ("f", (2, 3)), "corners": ("f", (2,)), "squares": ("f", ()),
    "shapes": ("i", (2,)), "outermost": ("b", ()),
}  # fmt: skip


class Layout:
    """The planes of a building."""

    EXPECTED: ClassVar[dict[str, tuple[str, int]]] = {
        **{name: (kind, 1 + len(shape)) for name, (kind, shape) in _ROWS.items()},
        "support": ("b", 1),
    }

    def __init__(self, planes: Sequence[Plane]):
        self.planes = tuple(planes)
        arrays = self.to_arrays()
        starts = np.cumsum([0, *arrays["shapes"].prod(axis=1)], dtype=np.int64)[:-1]
        far = np.where(arrays["outermost"], _FAR_OUTERMOST, _FAR)
        names = ("normals", "offsets", "axes", "corners", "squares", "shapes", "support")
        self._packed = (*(arrays[name] for name in names), starts, far)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The planes as arrays with the names and kinds of ``Layout.EXPECTED``."""
        planes = self.planes
        return {
            "normals": np.array([plane.normal for plane in planes], np.float64).reshape(-1, 3),
            "offsets": np.array([plane.offset for plane in planes], np.float64),
            "axes": np.array([plane.axes for plane in planes], np.float64).reshape(-1, 2, 3),
            "corners": np.array([plane.corner for plane in planes], np.float64).reshape(-1, 2),
            "squares": np.array([plane.square for plane in planes], np.float64),
            "shapes": np.array([plane.support.shape for plane in planes], np.int64).reshape(-1, 2),
            "support": np.concatenate([plane.support.ravel() for plane in planes] or [np.zeros(0, bool)]),
            "outermost": np.array([plane.outermost for plane in planes], bool),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> Layout:
        """The inverse of ``to_arrays``. Raises ValueError for inconsistent arrays."""
        count, rows = len(arrays["offsets"]), [arrays[name] for name in _ROWS]
        fit = all(row.shape == (count, *shape) for row, (_, shape) in zip(rows, _ROWS.values(), strict=True))
        if not fit or not all(np.isfinite(row).all() for row in rows) or not (arrays["squares"] > 0).all():
            raise ValueError("arrays that do not describe planes")
        sizes = arrays["shapes"].astype(np.float64).prod(axis=1)  # integers would overflow
        if (arrays["shapes"] <= 0).any() or sizes.sum() != len(arrays["support"]):
            raise ValueError("planes whose sizes do not match their squares")
        normals, offsets, axes, corners, squares, shapes, outermost = rows
        parts = np.split(arrays["support"], np.cumsum(sizes.astype(np.int64))[:-1]) if count else []
        return cls(
            [
                Plane(normal, float(offset), across, corner, float(square), part.reshape(shape), bool(out))
                for normal, offset, across, corner, square, shape, part, out in zip(
                    normals, offsets, axes, corners, squares, shapes, parts, outermost, strict=True
                )
            ]
        )

    def near(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64], times: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Find planes near a surface, to replace it.

        directions: (N, 3) of rays from ``origin``.  times: (N,) ray parameters where the rays meet the surface.
        Returns (N,) ray parameters of the first supported plane at about the depth of the surface; 0 = none. A plane
        may not lie clearly before the surface, because that space is free."""
        return _nearest(origin, directions, times, *self._packed)


@njit(cache=True)
def _nearest(origin, directions, times, normals, offsets, axes, corners, squares, shapes, support, starts, far):  # type: ignore[no-untyped-def]
    found = np.zeros(len(directions))
    for ray in range(len(directions)):
        x, y, z = directions[ray]
        best = np.inf
        for k in range(len(normals)):
            facing = normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * z
            if abs(facing) < 1e-6:
                continue
            height = offsets[k] - (normals[k, 0] * origin[0] + normals[k, 1] * origin[1] + normals[k, 2] * origin[2])
            t = height / facing
            if not (_NEAR * times[ray] < t < far[k] * times[ray]) or t <= 0.0 or t >= best:
                continue
            px, py, pz = origin[0] + t * x, origin[1] + t * y, origin[2] + t * z
            u = axes[k, 0, 0] * px + axes[k, 0, 1] * py + axes[k, 0, 2] * pz - corners[k, 0]
            v = axes[k, 1, 0] * px + axes[k, 1, 1] * py + axes[k, 1, 2] * pz - corners[k, 1]
            i, j = int(np.floor(u / squares[k])), int(np.floor(v / squares[k]))
            if 0 <= i < shapes[k, 0] and 0 <= j < shapes[k, 1] and support[starts[k] + i * shapes[k, 1] + j]:
                best = t
        if best < np.inf:
            found[ray] = best
    return found
