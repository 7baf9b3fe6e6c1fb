"""Draws boxes around the things of a picture, and writes their names beside them, so that none covers another."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .lettering import SMALL, measure_text, write_text
from .scene_rendering import BACKGROUND, NEAR_M, DrawnBox, ViewCamera
from .view_cameras import pixels_of

_LONGEST = 24  # characters
_PADDING, _HEIGHT = 4, SMALL + 8  # pixels beside the text, and of the label
_GAP, _LEADER = 4, 12  # pixels between a label and its thing; from how many on a line joins them
_RINGS = 6
_COVERS = 1.5  # cost of covering another thing, in rings of distance
_INSIDE = 1.2  # the same of a label on its own thing
_STAYS = 0.4  # by how much another place must be better than the last one
_OPAQUE = 0.85

_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]
_MOST_PX = 30_000.0  # OpenCV's lines have 16 bits before the point

_SIDES = np.array([(0, -1), (0, 1), (1, 0), (-1, 0), (1, -1), (-1, -1), (1, 1), (-1, 1)])

Rectangle = NDArray[np.float64]
"""(…, 4) x0, y0, x1, y1 pixels."""


class NamePlaces:
    """The places of the names of boxes. In each view they stay on the side of the last one, if they can."""

    def __init__(self, boxes: Sequence[DrawnBox]):
        self._named = [box for box in boxes if box.name]
        self._texts = [_shortened(box.name) for box in self._named]
        self._chosen = [-1] * len(self._named)
        self._labels: list[tuple[int, Rectangle, NDArray[np.float64]]] = []

    def choose(self, camera: ViewCamera) -> None:
        """Finds the places for a view. A name that has no room is left out."""
        size = camera.intrinsics.width, camera.intrinsics.height
        corners = [_corners_in_view(box, camera) for box in self._named]
        within = [_bounds(pixels, size) for pixels in corners]
        seen = [row for row, thing in enumerate(within) if thing is not None]
        outlines = np.array([within[row] for row in seen]).reshape(-1, 4)
        taken = np.zeros((0, 4))
        self._labels = []
        for at, row in enumerate(seen):
            places = _candidates(outlines[at], measure_text(self._texts[row], SMALL) + 2 * _PADDING)
            others = np.delete(outlines, at, axis=0)
            cost = _costs(places, taken, others, size)
            if self._chosen[row] >= 0:
                cost[self._chosen[row]] -= _STAYS
            best = int(np.argmin(cost))
            if np.isfinite(cost[best]):
                self._chosen[row] = best
                self._labels.append((row, places[best], corners[row]))
                taken = np.concatenate((taken, places[best][None]))

    def write(self, picture: NDArray[np.uint8]) -> None:
        """Writes the names into the (H, W, 3) view, with a line to the thing where it is not near."""
        for row, label, corners in self._labels:
            start, end = _nearest(label, corners)
            if np.linalg.norm(end - start) > _LEADER:
                ends = np.rint((start, end)).astype(int).tolist()
                cv2.line(picture, *ends, self._named[row].color, 1, cv2.LINE_AA)
        for row, label, _ in self._labels:
            x, y = np.rint(label[:2]).astype(int).tolist()
            write_label(picture, self._texts[row], (x, y), self._named[row].color)


def write_label(
    picture: NDArray[np.uint8], text: str, at: tuple[int, int], color: tuple[int, int, int] = BACKGROUND
) -> None:
    """Writes a text on a bright ground with a border. at: x, y of its upper left corner, pixels."""
    x, y = at
    width = measure_text(text, SMALL) + 2 * _PADDING
    ground = picture[max(y, 0) : y + _HEIGHT, max(x, 0) : x + width]
    ground[:] = np.rint((1 - _OPAQUE) * ground + _OPAQUE * np.array(BACKGROUND)).astype(np.uint8)
    cv2.rectangle(picture, (x, y), (x + width - 1, y + _HEIGHT - 1), color, 2)
    write_text(picture, text, (x + _PADDING, y + _HEIGHT - 7), SMALL)


def draw_edges(image: NDArray[np.uint8], box: DrawnBox, camera: ViewCamera, width_px: int) -> None:
    """Draws the edges of a box over the (H, W, 3) view, those of a hidden thing, too."""
    height, width = image.shape[:2]
    _, depth = pixels_of(box.corners, camera)
    for a, b in _EDGES:
        ends = box.corners[[a, b]]
        if depth[[a, b]].max() <= NEAR_M:
            continue
        if depth[[a, b]].min() < NEAR_M:  # moves the end that is behind the camera to just before it
            share = (NEAR_M - depth[a]) / (depth[b] - depth[a])
            ends[int(depth[a] > depth[b])] = ends[0] + share * (ends[1] - ends[0])
        places = pixels_of(ends, camera)[0]
        if np.abs(places).max() > _MOST_PX:
            continue
        inside, start, end = cv2.clipLine((0, 0, width, height), *np.rint(places).astype(int).tolist())
        if inside:
            cv2.line(image, start, end, box.color, width_px, cv2.LINE_AA)


def _shortened(name: str) -> str:
    return name if len(name) <= _LONGEST else name[: _LONGEST - 3] + "..."


def _corners_in_view(box: DrawnBox, camera: ViewCamera) -> NDArray[np.float64]:
    """Returns the (N, 2) pixels of the corners that are in front of the camera, far ones moved near the view."""
    pixels, depth = pixels_of(box.corners, camera)
    far = 4.0 * max(camera.intrinsics.width, camera.intrinsics.height)
    return np.clip(pixels[depth > NEAR_M], -far, far)


def _bounds(pixels: NDArray[np.float64], size: tuple[int, int]) -> Rectangle | None:
    """Returns the (4,) part of the view around a box, or None if it is not in view."""
    if not len(pixels):
        return None
    low, high = np.maximum(pixels.min(axis=0), 0), np.minimum(pixels.max(axis=0), np.array(size) - 1)
    return np.concatenate((low, high)) if (high > low).all() else None


def _candidates(thing: Rectangle, width: int) -> Rectangle:
    """Returns the (C, 4) places of a label: rings around the thing, then places on it."""
    half = 0.5 * np.array((width, _HEIGHT))
    middle, reach = 0.5 * (thing[:2] + thing[2:]), 0.5 * (thing[2:] - thing[:2])
    rings = np.arange(_RINGS)[:, None, None] * (_HEIGHT + _GAP)
    around = middle + _SIDES * (reach + half + _GAP + rings)
    steps = np.concatenate((np.zeros((1, 2)), 0.5 * _SIDES))
    centers = np.concatenate((around.reshape(-1, 2), middle + steps * np.maximum(reach - half, 0)))
    return np.concatenate((centers - half, centers + half), axis=1)


def _costs(places: Rectangle, taken: Rectangle, others: Rectangle, size: tuple[int, int]) -> NDArray[np.float64]:
    """Returns the (C,) cost of each place; infinite where it leaves the view or covers another label."""
    rings = np.repeat(np.arange(_RINGS, dtype=float), len(_SIDES))
    cost = np.concatenate((rings, np.full(len(places) - len(rings), _INSIDE)))
    cost += np.arange(len(places)) % len(_SIDES) * 0.01
    area = np.prod(places[:, 2:] - places[:, :2], axis=1)
    cost += _COVERS * _overlaps(places, others).sum(axis=1) / area
    outside = (places[:, :2] < 0).any(axis=1) | (places[:, 2:] > size).any(axis=1)
    cost[outside | (_overlaps(places, taken) > 0).any(axis=1)] = np.inf
    return cost


def _overlaps(places: Rectangle, others: Rectangle) -> NDArray[np.float64]:
    """Returns the (N, M) areas that rectangles share."""
    low = np.maximum(places[:, None, :2], others[None, :, :2])
    high = np.minimum(places[:, None, 2:], others[None, :, 2:])
    return np.asarray(np.prod(np.maximum(high - low, 0), axis=2))


def _nearest(label: Rectangle, corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the (2,) point of the label and that of the box with these corners where a line joins them; the same
    point twice for a label on the box."""
    hull = cv2.convexHull(corners.astype(np.float32))[:, 0].astype(np.float64)
    middle = 0.5 * (label[:2] + label[2:])
    if cv2.pointPolygonTest(hull.astype(np.float32), middle.tolist(), False) >= 0:
        return middle, middle
    start, along = hull, np.roll(hull, -1, axis=0) - hull
    share = ((middle - start) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-9)
    near = start + np.clip(share, 0, 1)[:, None] * along
    end = near[np.argmin(np.linalg.norm(near - middle, axis=1))]
    return np.clip(end, label[:2], label[2:]), end
