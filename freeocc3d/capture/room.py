"""The built-in room: furniture as triangles with a class, a colour and a procedural texture each."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

SIZE = (5.2, 4.2, 2.6)
"""Extent of the room, metres; the world's origin is the middle of the floor, z is up."""

PLAIN, WOOD, CHECKER, BOOKS, PATCHES, PLASTER = range(6)
"""Kinds of texture."""

CLASSES = (
    "nothing", "wall", "floor", "ceiling", "rug", "table", "cup", "chair", "sofa", "cushion", "bed", "pillow",
    "wardrobe", "bookshelf", "television", "tv stand", "lamp", "plant", "trash can", "picture", "door", "window", "box",
)  # fmt: skip

CUPS = {"red": (1.92, 0.14, 0.75), "yellow": (1.92, 0.26, 0.75)}
"""Middle of each paper cup's foot, on the table."""

CUP_HEIGHT, CUP_FOOT, CUP_RIM = 0.09, 0.028, 0.038

Color = tuple[int, int, int]
_WOOD_BROWN, _DARK_WOOD, _LIGHT_WOOD = (139, 90, 43), (88, 54, 30), (196, 154, 108)


@dataclass
class Room:
    """Triangles of all objects.

    vertices: (3 T, 3) metres, world.  Per triangle: ``class_id`` (T,), ``object_id`` (T,), ``texture`` (T,) kind,
    ``color`` (T, 3) and ``second`` (T, 3) RGB 0…255, ``scale`` (T,) size of the texture's features in metres.
    objects: name of each object.
    """

    objects: list[str] = field(default_factory=list)
    _parts: list[tuple[NDArray[np.float64], int, int, int, Color, Color, float]] = field(default_factory=list)

    def add(
        self,
        name: str,
        triangles: NDArray[np.float64],
        color: Color,
        texture: int = PLAIN,
        second: Color | None = None,
        scale: float = 0.1,
        part_of: str | None = None,
    ) -> None:
        """Add (T, 3, 3) triangles of class ``name``; ``part_of`` joins them to the object added last."""
        if part_of is None:
            self.objects.append(name)
        class_id = CLASSES.index(part_of or name)
        self._parts.append((triangles, class_id, len(self.objects) - 1, texture, color, second or color, scale))

    def _each(self, column: int) -> NDArray[np.generic]:
        return np.concatenate([np.repeat([part[column]], len(part[0]), axis=0) for part in self._parts])

    @property
    def triangles(self) -> NDArray[np.float32]:
        """(T, 3, 3) corners, counter-clockwise from outside."""
        return np.concatenate([part[0] for part in self._parts]).astype(np.float32)

    @property
    def class_id(self) -> NDArray[np.uint8]:
        return self._each(1).astype(np.uint8)

    @property
    def object_id(self) -> NDArray[np.int32]:
        return self._each(2).astype(np.int32)

    @property
    def texture(self) -> NDArray[np.int32]:
        return self._each(3).astype(np.int32)

    @property
    def color(self) -> NDArray[np.float32]:
        return self._each(4).astype(np.float32)

    @property
    def second(self) -> NDArray[np.float32]:
        return self._each(5).astype(np.float32)

    @property
    def scale(self) -> NDArray[np.float32]:
        return self._each(6).astype(np.float32)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> NDArray[np.float64]:
    """(12, 3, 3) triangles of an axis-aligned box."""
    x, y, z = np.stack((low, high)).T
    quads = [
        [(x[0], y[0], z[0]), (x[0], y[1], z[0]), (x[1], y[1], z[0]), (x[1], y[0], z[0])],
        [(x[0], y[0], z[1]), (x[1], y[0], z[1]), (x[1], y[1], z[1]), (x[0], y[1], z[1])],
        [(x[0], y[0], z[0]), (x[1], y[0], z[0]), (x[1], y[0], z[1]), (x[0], y[0], z[1])],
        [(x[0], y[1], z[0]), (x[0], y[1], z[1]), (x[1], y[1], z[1]), (x[1], y[1], z[0])],
        [(x[0], y[0], z[0]), (x[0], y[0], z[1]), (x[0], y[1], z[1]), (x[0], y[1], z[0])],
        [(x[1], y[0], z[0]), (x[1], y[1], z[0]), (x[1], y[1], z[1]), (x[1], y[0], z[1])],
    ]
    return np.array([(quad[0], quad[i], quad[i + 1]) for quad in quads for i in (1, 2)])


def lathe(middle: tuple[float, float], profile: list[tuple[float, float]], sides: int = 24) -> NDArray[np.float64]:
    """Triangles of a surface of revolution about a vertical axis; profile: (radius, height) from bottom to top."""
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    triangles = []
    for (r0, z0), (r1, z1) in pairwise(profile):
        for i in range(sides):
            a, b = (np.array((*(middle + r0 * ring[j]), z0)) for j in (i, i + 1))
            c, d = (np.array((*(middle + r1 * ring[j]), z1)) for j in (i, i + 1))
            triangles += [(a, b, d)] * (r0 > 0) + [(a, d, c)] * (r1 > 0)  # a point is no edge
    return np.array(triangles)


def furnished() -> Room:
    """The room with everything in it."""
    room = Room()
    _shell(room)
    _table_and_cups(room)
    _chair(room, (1.95, -0.85), (35, 80, 190))
    _chair(room, (1.95, 1.30), (40, 140, 60))
    _sofa(room)
    _bed(room)
    _storage(room)
    _television(room)
    _small_things(room)
    _on_the_walls(room)
    return room


def _shell(room: Room) -> None:
    x, y, z = SIZE[0] / 2, SIZE[1] / 2, SIZE[2]
    t = 0.1
    room.add("floor", box((-x, -y, -t), (x, y, 0)), (176, 136, 92), WOOD, (140, 102, 66), 0.12)
    room.add("ceiling", box((-x, -y, z), (x, y, z + t)), (236, 234, 228), PLASTER, (214, 212, 206), 0.25)
    walls = [
        ((-x - t, -y, 0), (-x, y, z)),
        ((x, -y, 0), (x + t, y, z)),
        ((-x, -y - t, 0), (x, -y, z)),
        ((-x, y, 0), (x, y + t, z)),
    ]
    tints = [(226, 222, 210), (214, 220, 226), (228, 216, 204), (218, 226, 214)]
    for (low, high), tint in zip(walls, tints, strict=True):
        shadow: Color = (tint[0] - 30, tint[1] - 30, tint[2] - 30)
        room.add("wall", box(low, high), tint, PLASTER, shadow, 0.22)
    room.add("rug", box((-1.0, -0.7, 0), (1.0, 0.7, 0.012)), (52, 74, 128), CHECKER, (222, 210, 182), 0.16)


def _legs(low: tuple[float, float], high: tuple[float, float], top: float, w: float) -> NDArray[np.float64]:
    return np.concatenate(
        [box((x, y, 0), (x + w, y + w, top)) for x in (low[0], high[0] - w) for y in (low[1], high[1] - w)]
    )


def _table_and_cups(room: Room) -> None:
    low, high = (1.65, -0.45), (2.45, 0.95)
    room.add("table", box((*low, 0.71), (*high, 0.75)), _WOOD_BROWN, WOOD, _DARK_WOOD, 0.07)
    room.add("legs", _legs(low, high, 0.71, 0.06), _DARK_WOOD, WOOD, (70, 44, 24), 0.05, part_of="table")
    colors: dict[str, Color] = {"red": (205, 28, 34), "yellow": (238, 200, 30)}
    for name, (x, y, z) in CUPS.items():
        outside = [(0.0, z), (CUP_FOOT, z), (CUP_RIM, z + CUP_HEIGHT)]
        inside = [(CUP_RIM - 0.002, z + CUP_HEIGHT), (CUP_FOOT - 0.002, z + 0.004), (0.0, z + 0.004)]
        room.add("cup", lathe((x, y), outside + inside), colors[name], PLAIN, scale=0.02)


def _chair(room: Room, middle: tuple[float, float], color: Color) -> None:
    x, y = middle
    seat_low, seat_high = (x - 0.21, y - 0.21), (x + 0.21, y + 0.21)
    room.add("chair", box((*seat_low, 0.42), (*seat_high, 0.47)), color, PLAIN, scale=0.06)
    room.add("legs", _legs(seat_low, seat_high, 0.42, 0.04), color, PLAIN, scale=0.06, part_of="chair")
    room.add("back", box((x + 0.17, y - 0.21, 0.47), (x + 0.21, y + 0.21, 0.92)), color, part_of="chair", scale=0.06)


def _sofa(room: Room) -> None:
    white = (232, 229, 222)
    room.add("sofa", box((-0.75, 1.30, 0.08), (0.95, 2.05, 0.42)), white, PLASTER, (206, 202, 194), 0.05)
    for low, high in (
        ((-0.75, 1.85, 0.42), (0.95, 2.08, 0.85)),
        ((-0.95, 1.30, 0.05), (-0.75, 2.05, 0.62)),
        ((0.95, 1.30, 0.05), (1.15, 2.05, 0.62)),
    ):
        room.add("part", box(low, high), white, PLASTER, (206, 202, 194), 0.05, part_of="sofa")
    room.add("cushion", box((-0.6, 1.62, 0.42), (-0.2, 1.82, 0.78)), (232, 120, 28), PLAIN, scale=0.05)
    room.add("cushion", box((0.45, 1.62, 0.42), (0.85, 1.82, 0.78)), (120, 50, 150), PLAIN, scale=0.05)


def _bed(room: Room) -> None:
    room.add("bed", box((-2.55, -1.6, 0.1), (-1.05, -0.5, 0.42)), _LIGHT_WOOD, WOOD, _WOOD_BROWN, 0.08)
    mattress = box((-2.5, -1.56, 0.42), (-1.08, -0.54, 0.55))
    room.add("mattress", mattress, (70, 150, 190), CHECKER, (220, 232, 238), 0.11, part_of="bed")
    room.add("board", box((-2.6, -1.6, 0.1), (-2.53, -0.5, 0.95)), _LIGHT_WOOD, WOOD, _WOOD_BROWN, 0.08, part_of="bed")
    room.add("pillow", box((-2.48, -1.35, 0.55), (-2.12, -0.75, 0.66)), (240, 238, 236), PLASTER, (214, 212, 212), 0.04)


def _storage(room: Room) -> None:
    room.add("wardrobe", box((-2.58, 0.75, 0), (-2.0, 2.05, 2.0)), _LIGHT_WOOD, WOOD, (164, 122, 78), 0.10)
    for y in (1.34, 1.44):
        handle = box((-2.0, y, 0.9), (-1.97, y + 0.02, 1.15))
        room.add("handle", handle, (60, 60, 62), PLAIN, part_of="wardrobe", scale=0.03)
    low, high = (0.35, -2.08), (1.35, -1.78)
    for z in (0.02, 0.42, 0.82, 1.22, 1.62):
        board = box((*low, z), (*high, z + 0.03))
        joined = "bookshelf" if z > 0.02 else None
        room.add(
            "bookshelf" if joined is None else "board", board, _DARK_WOOD, WOOD, (60, 36, 20), 0.06, part_of=joined
        )
        if z < 1.6:
            books = box((low[0] + 0.04, -2.06, z + 0.03), (high[0] - 0.12, -1.84, z + 0.3))
            room.add("books", books, (160, 60, 50), BOOKS, (40, 70, 120), 0.045, part_of="bookshelf")
    for x in (low[0], high[0] - 0.03):
        side = box((x, low[1], 0), (x + 0.03, high[1], 1.65))
        room.add("side", side, _DARK_WOOD, WOOD, (60, 36, 20), 0.06, part_of="bookshelf")
    room.add("box", box((1.55, -2.0, 0), (2.0, -1.65, 0.35)), (30, 150, 150), PLAIN, scale=0.05)


def _television(room: Room) -> None:
    room.add("tv stand", box((-0.95, -2.05, 0), (0.15, -1.65, 0.45)), (120, 78, 46), WOOD, (94, 58, 32), 0.07)
    room.add("television", box((-0.9, -1.95, 0.52), (0.1, -1.90, 1.10)), (14, 14, 16), PATCHES, (34, 40, 60), 0.18)
    room.add("foot", box((-0.55, -1.98, 0.45), (-0.25, -1.82, 0.52)), (20, 20, 22), part_of="television")


def _small_things(room: Room) -> None:
    stand = [(0.0, 0.0), (0.14, 0.0), (0.14, 0.03), (0.015, 0.04), (0.015, 1.35)]
    room.add("lamp", lathe((-1.35, -1.85), stand), (70, 70, 74))
    shade = [(0.20, 1.30), (0.13, 1.62), (0.0, 1.62)]
    room.add("shade", lathe((-1.35, -1.85), shade), (240, 222, 150), PLASTER, (222, 200, 120), 0.06, part_of="lamp")
    pot = [(0.0, 0.0), (0.12, 0.0), (0.16, 0.30), (0.14, 0.30), (0.13, 0.26), (0.0, 0.26)]
    room.add("plant", lathe((-1.45, 1.75), pot), (186, 96, 58), PLASTER, (160, 78, 46), 0.04)
    for radius, low, high in ((0.24, 0.30, 0.62), (0.20, 0.52, 0.86), (0.14, 0.78, 1.08)):
        middle = 0.5 * (low + high)
        leaves = [(0.0, low), (0.6 * radius, low + 0.06), (radius, middle), (0.6 * radius, high - 0.05), (0.0, high)]
        room.add(
            "leaves", lathe((-1.45, 1.75), leaves, 14), (44, 124, 48), PATCHES, (24, 82, 30), 0.05, part_of="plant"
        )
    can = [(0.0, 0.0), (0.12, 0.0), (0.15, 0.36), (0.14, 0.36), (0.11, 0.02), (0.0, 0.02)]
    room.add("trash can", lathe((1.60, 1.80), can), (96, 98, 104), PLASTER, (76, 78, 84), 0.05)


def _on_the_walls(room: Room) -> None:
    x, y = SIZE[0] / 2, SIZE[1] / 2
    room.add("picture", box((x - 0.03, -0.35, 1.25), (x, 0.35, 1.80)), (190, 70, 50), PATCHES, (50, 90, 160), 0.12)
    room.add("picture", box((x - 0.03, 0.75, 1.20), (x, 1.30, 1.90)), (230, 190, 90), PATCHES, (60, 110, 80), 0.10)
    room.add(
        "picture", box((-x, -1.45, 1.30), (-x + 0.03, -0.65, 1.85)), (80, 150, 180), PATCHES, (230, 150, 120), 0.13
    )
    room.add(
        "picture", box((-0.75, -y, 1.35), (-0.05, -y + 0.03, 1.85)), (150, 60, 120), PATCHES, (240, 220, 150), 0.11
    )
    room.add("door", box((-x, -0.25, 0), (-x + 0.04, 0.60, 2.05)), (150, 98, 58), WOOD, (118, 74, 42), 0.12)
    room.add("knob", box((-x + 0.04, 0.48, 1.0), (-x + 0.09, 0.54, 1.05)), (190, 180, 120), part_of="door", scale=0.03)
    room.add("window", box((-0.5, y - 0.03, 1.15), (0.9, y, 2.1)), (168, 206, 236), PATCHES, (214, 232, 246), 0.3)
    for low, high in (
        ((-0.56, y - 0.05, 1.09), (0.96, y, 1.15)),
        ((-0.56, y - 0.05, 2.10), (0.96, y, 2.16)),
        ((-0.56, y - 0.05, 1.09), (-0.50, y, 2.16)),
        ((0.90, y - 0.05, 1.09), (0.96, y, 2.16)),
        ((0.17, y - 0.05, 1.15), (0.23, y, 2.10)),
    ):
        room.add("frame", box(low, high), (244, 244, 240), PLASTER, (220, 220, 216), 0.05, part_of="window")
