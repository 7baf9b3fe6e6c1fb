"""The built-in room: furniture as triangles, each with a class and a material."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

SIZE = (5.2, 4.2, 2.5)
"""Extent of the room, meters. The world origin is the middle of the floor; z points up."""

CLASSES = (
    "nothing", "wall", "floor", "ceiling", "rug", "table", "cup", "chair", "sofa", "cushion", "bed", "pillow",
    "wardrobe", "bookshelf", "television", "tv stand", "lamp", "plant", "trash can", "picture", "door", "window", "box",
)  # fmt: skip

CUPS = {"red": (1.92, 0.14, 0.75), "yellow": (1.92, 0.26, 0.75)}
"""Center of each paper cup's foot on the table, world, meters."""

CUP_HEIGHT, CUP_FOOT, CUP_RIM = 0.09, 0.028, 0.038
"""Height and radii of a paper cup, meters."""

PLAIN, WOOD, CHECKER, BOOKS, PATCHES, PLASTER, STRIPES, PAINTING = range(8)
"""Kinds of texture."""

Point = tuple[float, float, float]
Color = tuple[int, int, int]
Triangles = NDArray[np.float64]
"""(T, 3, 3) corners, world, meters, counter-clockwise as seen from outside."""


@dataclass(frozen=True)
class Material:
    """A procedural texture between two colors (RGB 0…255). scale: feature size, meters."""

    color: Color
    texture: int = PLAIN
    second: Color = (0, 0, 0)
    scale: float = 0.06


@dataclass(frozen=True)
class Room:
    """All objects of the room, as T triangles.

    objects: class name of each object.
    Per triangle: triangles (T, 3, 3) float32 corners, world, meters; normals (T, 3) float32, unit, outward;
    class_ids (T,) uint8, index into CLASSES; object_ids (T,) int32, index into ``objects``;
    textures (T,) int32 kinds; colors (T, 2, 3) float32, the material's two colors; scales (T,) float32 meters.
    """

    objects: tuple[str, ...]
    triangles: NDArray[np.float32]
    normals: NDArray[np.float32]
    class_ids: NDArray[np.uint8]
    object_ids: NDArray[np.int32]
    textures: NDArray[np.int32]
    colors: NDArray[np.float32]
    scales: NDArray[np.float32]


class _Builder:
    """Collects objects. Each part of an object has one material."""

    def __init__(self) -> None:
        self._objects: list[str] = []
        self._parts: list[tuple[int, Triangles, Material]] = []

    def add(self, name: str, *parts: tuple[Triangles, Material]) -> None:
        """Add one object of class ``name``."""
        self._objects.append(name)
        self._parts += [(len(self._objects) - 1, triangles, material) for triangles, material in parts]

    def build(self) -> Room:
        counts = [len(triangles) for _, triangles, _ in self._parts]
        materials = [material for _, _, material in self._parts]
        corners = np.concatenate([triangles for _, triangles, _ in self._parts])
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        object_ids = np.repeat([number for number, _, _ in self._parts], counts)
        return Room(
            tuple(self._objects),
            corners.astype(np.float32),
            normals.astype(np.float32),
            np.array([CLASSES.index(name) for name in self._objects], np.uint8)[object_ids],
            object_ids.astype(np.int32),
            np.repeat([m.texture for m in materials], counts).astype(np.int32),
            np.repeat([(m.color, m.second) for m in materials], counts, axis=0).astype(np.float32),
            np.repeat([m.scale for m in materials], counts).astype(np.float32),
        )


def quad(corner: ArrayLike, u: ArrayLike, v: ArrayLike) -> Triangles:
    """(2, 3, 3) parallelogram from a corner and two edges; it faces along u x v."""
    a, b, d = np.asarray(corner), np.add(corner, u), np.add(corner, v)
    c = np.add(b, v)
    return np.array([(a, b, c), (a, c, d)])


def box(low: ArrayLike, high: ArrayLike) -> Triangles:
    """(12, 3, 3) axis-aligned box."""
    x, y, z = np.diag(np.subtract(high, low))
    at_low = [quad(low, y, x), quad(low, x, z), quad(low, z, y)]
    at_high = [quad(high, -x, -y), quad(high, -z, -x), quad(high, -y, -z)]
    return np.concatenate(at_low + at_high)


def legs(low: tuple[float, float], high: tuple[float, float], top: float, width: float) -> Triangles:
    """Four square legs below the corners of a rectangle."""
    at = [(x, y) for x in (low[0], high[0] - width) for y in (low[1], high[1] - width)]
    return np.concatenate([box((x, y, 0), (x + width, y + width, top)) for x, y in at])


def lathe(middle: tuple[float, float], profile: list[tuple[float, float]], sides: int = 24) -> Triangles:
    """A surface of revolution about a vertical axis. profile: (radius, height) of its rings, in an order that keeps the
    outside to the right: up the outer side of a cup, then down its inner side."""
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    circle = np.stack((np.cos(angles), np.sin(angles), 0 * angles), axis=1)
    rings = [np.array((*middle, z)) + r * circle for r, z in profile]
    triangles = []
    for (r0, _), (r1, _), lower, upper in zip(profile[:-1], profile[1:], rings[:-1], rings[1:], strict=True):
        if r0 > 0:
            triangles.append(np.stack((lower[:-1], lower[1:], upper[1:]), axis=1))
        if r1 > 0:
            triangles.append(np.stack((lower[:-1], upper[1:], upper[:-1]), axis=1))
    return np.concatenate(triangles)


_BROWN_WOOD = Material((142, 94, 50), WOOD, (104, 66, 36), 0.07)
_DARK_WOOD = Material((88, 56, 34), WOOD, (60, 37, 22), 0.06)
_LIGHT_WOOD = Material((204, 168, 120), WOOD, (172, 132, 88), 0.10)
_WHITE_PAINT = Material((246, 246, 242), PLASTER, (222, 222, 218), 0.05)
_WHITE_CLOTH = Material((238, 236, 230), PLASTER, (208, 205, 198), 0.05)
_METAL = Material((82, 83, 88), PLASTER, (62, 63, 68), 0.04)


def build_room() -> Room:
    """The room with everything in it."""
    room = _Builder()
    _shell(room)
    _table_and_cups(room)
    _chair(room, (2.06, -0.72), (0, -1), Material((36, 82, 196)))
    _chair(room, (2.06, 1.20), (0, 1), Material((40, 146, 62)))
    _chair(room, (2.27, -1.76), (0, -1), _LIGHT_WOOD)
    _sofa(room)
    _bed(room)
    _storage(room)
    _television(room)
    _small_things(room)
    _on_the_walls(room)
    return room.build()


def _shell(room: _Builder) -> None:
    x, y, z = SIZE[0] / 2, SIZE[1] / 2, SIZE[2]
    along_x, along_y, up = (2 * x, 0.0, 0.0), (0.0, 2 * y, 0.0), (0.0, 0.0, z)
    room.add("floor", (quad((-x, -y, 0), along_x, along_y), Material((186, 146, 102), WOOD, (152, 112, 74), 0.12)))
    ceiling = Material((240, 238, 232), PLASTER, (220, 218, 212), 0.25)
    room.add("ceiling", (quad((-x, -y, z), along_y, along_x), ceiling))
    d, h = 0.015, 0.09  # the skirting board's thickness and height
    walls = (
        ((-x, -y, 0), along_y, up, box((-x, -y, 0), (-x + d, y, h)), (232, 226, 208), (206, 200, 184), PLASTER),
        ((x, -y, 0), up, along_y, box((x - d, -y, 0), (x, y, h)), (212, 222, 232), (188, 202, 218), STRIPES),
        ((-x, -y, 0), up, along_x, box((-x, -y, 0), (x, -y + d, h)), (236, 222, 210), (210, 196, 184), PLASTER),
        ((-x, y, 0), along_x, up, box((-x, y - d, 0), (x, y, h)), (222, 230, 216), (198, 206, 192), PLASTER),
    )
    for corner, u, v, skirting, color, second, texture in walls:
        room.add("wall", (quad(corner, u, v), Material(color, texture, second, 0.16)), (skirting, _WHITE_PAINT))
    rug = Material((150, 44, 60), CHECKER, (226, 212, 182), 0.16)
    room.add("rug", (box((-2.35, -0.38, 0), (-1.0, 0.66, 0.012)), rug))


def _table_and_cups(room: _Builder) -> None:
    low, high = (1.65, -0.45), (2.45, 0.95)
    room.add("table", (box((*low, 0.71), (*high, 0.75)), _BROWN_WOOD), (legs(low, high, 0.71, 0.06), _DARK_WOOD))
    colors = {"red": (208, 26, 32), "yellow": (242, 204, 28)}
    for name, (x, y, z) in CUPS.items():
        outside = [(0.0, z), (CUP_FOOT, z), (CUP_RIM, z + CUP_HEIGHT)]
        inside = [(CUP_RIM - 0.002, z + CUP_HEIGHT), (CUP_FOOT - 0.002, z + 0.004), (0.0, z + 0.004)]
        room.add("cup", (lathe((x, y), outside + inside), Material(colors[name], scale=0.02)))


def _chair(room: _Builder, middle: tuple[float, float], back: tuple[int, int], material: Material) -> None:
    """back: the side of the seat where the backrest stands, as a unit vector along x or y."""
    x, y = middle
    low, high = (x - 0.21, y - 0.21), (x + 0.21, y + 0.21)
    bx, by = x + 0.19 * back[0], y + 0.19 * back[1]
    wx, wy = (0.02, 0.21) if back[0] else (0.21, 0.02)
    seat, rest = box((*low, 0.42), (*high, 0.47)), box((bx - wx, by - wy, 0.47), (bx + wx, by + wy, 0.92))
    room.add("chair", (np.concatenate([seat, rest, legs(low, high, 0.42, 0.04)]), material))


def _sofa(room: _Builder) -> None:
    seat, back = box((-0.75, 1.30, 0.05), (0.95, 2.05, 0.42)), box((-0.75, 1.84, 0.42), (0.95, 2.08, 0.85))
    arms = [box((x, 1.30, 0.05), (x + 0.2, 2.08, 0.62)) for x in (-0.95, 0.95)]
    room.add("sofa", (np.concatenate([seat, back, *arms]), _WHITE_CLOTH))
    room.add("cushion", (box((-0.60, 1.68, 0.42), (-0.20, 1.84, 0.78)), Material((236, 122, 26))))
    room.add("cushion", (box((0.45, 1.68, 0.42), (0.85, 1.84, 0.78)), Material((122, 50, 156))))


def _bed(room: _Builder) -> None:
    cover = Material((74, 156, 200), CHECKER, (226, 236, 242), 0.12)
    room.add(
        "bed",
        (box((-2.53, -1.62, 0.10), (-1.05, -0.50, 0.42)), _LIGHT_WOOD),
        (box((-2.50, -1.58, 0.42), (-1.08, -0.54, 0.55)), cover),
        (box((-2.59, -1.62, 0.0), (-2.53, -0.50, 0.95)), _LIGHT_WOOD),
        (legs((-2.50, -1.60), (-1.10, -0.52), 0.10, 0.08), _LIGHT_WOOD),
    )
    room.add("pillow", (box((-2.48, -1.35, 0.55), (-2.12, -0.75, 0.66)), _WHITE_CLOTH))


def _storage(room: _Builder) -> None:
    handles = np.concatenate([box((-1.98, y, 0.9), (-1.95, y + 0.02, 1.15)) for y in (1.34, 1.44)])
    gap = box((-1.98, 1.39, 0.06), (-1.978, 1.41, 1.96))
    doors = box((-2.59, 0.75, 0), (-1.98, 2.05, 2.0))
    room.add("wardrobe", (doors, _LIGHT_WOOD), (handles, _METAL), (gap, _METAL))
    boards = [box((0.35, -2.09, z), (1.35, -1.78, z + 0.03)) for z in (0.02, 0.42, 0.82, 1.22, 1.62)]
    sides = [box((x, -2.09, 0), (x + 0.03, -1.78, 1.65)) for x in (0.35, 1.32)]
    books = [
        box((0.40, -2.06, z + 0.03), (0.40 + length, -1.83, z + 0.03 + height))
        for z, length, height in ((0.02, 0.86, 0.30), (0.42, 0.70, 0.27), (0.82, 0.88, 0.29), (1.22, 0.62, 0.25))
    ]
    spines = Material((176, 62, 50), BOOKS, (44, 86, 140), 0.045)
    room.add("bookshelf", (np.concatenate(boards + sides), _DARK_WOOD), (np.concatenate(books), spines))
    room.add("box", (box((1.55, -2.0, 0), (1.98, -1.62, 0.35)), Material((28, 156, 156))))


def _television(room: _Builder) -> None:
    room.add("tv stand", (box((-0.95, -2.05, 0), (0.15, -1.65, 0.45)), _BROWN_WOOD))
    room.add(
        "television",
        (box((-0.90, -1.95, 0.53), (0.10, -1.90, 1.10)), Material((13, 13, 15), PATCHES, (36, 40, 56), 0.2)),
        (box((-0.55, -1.99, 0.45), (-0.25, -1.82, 0.53)), _METAL),
    )


def _small_things(room: _Builder) -> None:
    stand = [(0.0, 0.0), (0.14, 0.0), (0.14, 0.03), (0.015, 0.04), (0.015, 1.32)]
    hood = [(0.0, 1.32), (0.19, 1.32), (0.20, 1.30), (0.13, 1.62), (0.0, 1.62)]
    cloth = Material((246, 226, 160), PLASTER, (228, 204, 128), 0.06)
    room.add("lamp", (lathe((-1.35, -1.85), stand), _METAL), (lathe((-1.35, -1.85), hood), cloth))
    clay = Material((190, 100, 62), PLASTER, (164, 82, 50), 0.04)
    leaf = Material((48, 134, 52), PATCHES, (22, 84, 30), 0.05)
    pot = [(0.0, 0.0), (0.12, 0.0), (0.16, 0.30), (0.14, 0.30), (0.13, 0.26), (0.0, 0.26)]
    crown = [
        lathe((-1.45, 1.75), [(0.0, z), (0.6 * r, z + 0.06), (r, z + 0.17), (0.6 * r, z + 0.28), (0.0, z + 0.33)], 14)
        for r, z in ((0.24, 0.30), (0.20, 0.52), (0.14, 0.76))
    ]
    room.add("plant", (lathe((-1.45, 1.75), pot), clay), (np.concatenate(crown), leaf))
    can = [(0.0, 0.0), (0.12, 0.0), (0.15, 0.36), (0.14, 0.36), (0.11, 0.02), (0.0, 0.02)]
    room.add("trash can", (lathe((1.60, 1.80), can), _METAL))


def _on_the_walls(room: _Builder) -> None:
    x, y = SIZE[0] / 2, SIZE[1] / 2
    _picture(room, (x - 0.02, -0.35, 1.25), (x, 0.35, 1.80), (196, 72, 48), (52, 92, 168), 0.22)
    _picture(room, (x - 0.02, 0.75, 1.20), (x, 1.30, 1.90), (234, 192, 84), (56, 112, 84), 0.17)
    _picture(room, (-x, -1.45, 1.30), (-x + 0.02, -0.65, 1.85), (80, 152, 184), (232, 150, 116), 0.20)
    _picture(room, (-0.75, -y, 1.35), (-0.05, -y + 0.02, 1.85), (152, 58, 118), (242, 222, 148), 0.18)
    panels = [box((-x + 0.04, a, c), (-x + 0.05, a + 0.30, c + 0.75)) for a in (-0.18, 0.22) for c in (0.2, 1.12)]
    leaf = Material((168, 112, 68), WOOD, (136, 86, 50), 0.10)
    room.add(
        "door",
        (box((-x, -0.25, 0), (-x + 0.04, 0.60, 2.05)), leaf),
        (np.concatenate(panels), _BROWN_WOOD),
        (box((-x + 0.04, 0.53, 0.98), (-x + 0.10, 0.57, 1.02)), Material((206, 190, 110))),
    )
    sky = Material((150, 196, 236), PATCHES, (232, 240, 248), 0.3)
    bars = [
        *(box((-0.56, y - 0.05, z), (0.96, y, z + 0.06)) for z in (1.09, 2.10)),
        *(box((x, y - 0.05, 1.15), (x + 0.06, y, 2.10)) for x in (-0.56, 0.17, 0.90)),
    ]
    room.add("window", (box((-0.5, y - 0.02, 1.15), (0.9, y, 2.1)), sky), (np.concatenate(bars), _WHITE_PAINT))


def _picture(room: _Builder, low: Point, high: Point, color: Color, second: Color, scale: float) -> None:
    """A painting in a frame 3 cm wide. The canvas stands out 5 mm in front and behind, so it fits on any wall."""
    extent = np.subtract(high, low)
    inset = np.where(extent == extent.min(), -0.005, 0.03)
    canvas = box(np.add(low, inset), np.subtract(high, inset))
    room.add("picture", (box(low, high), _DARK_WOOD), (canvas, Material(color, PAINTING, second, scale)))
