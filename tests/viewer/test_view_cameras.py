"""Cameras of pictures: what they aim at is where they say, for voxels and for Gaussians alike."""

import numpy as np
import pytest

from freeocc3d.core.types import Gaussians
from freeocc3d.viewer.gaussian_views import GaussianPainter
from freeocc3d.viewer.names_on_things import draw_edges
from freeocc3d.viewer.scene_rendering import DrawnBox, DrawnScene, render_scene
from freeocc3d.viewer.view_cameras import aim, aim_around, aim_from, pixels_of

SIZE = 320, 240


def quad(middle, edge=0.4, color=(200, 30, 30), axis=2):
    """(4, 3) corners of a square across an axis, and its color."""
    corners = np.zeros((4, 3))
    corners[:, [k for k in range(3) if k != axis]] = edge * np.array(
        ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
    )
    return corners + middle, color


def scene_of(*quads, boxes=()) -> DrawnScene:
    vertices = np.concatenate([corners for corners, _ in quads])
    colors = np.array([color for _, color in quads], np.uint8)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 4)
    return DrawnScene(vertices, faces, colors, np.zeros((0, 3)), boxes)


def middle_of(image, color) -> np.ndarray:
    """The (u, v) mean of the pixels of about a color."""
    return np.argwhere(np.abs(image.astype(int) - color).max(axis=2) < 60).mean(axis=0)[::-1]


CAMERAS = {
    "above": lambda scene: aim(scene, "above", SIZE),
    "corner": lambda scene: aim(scene, "corner", SIZE),
    "around": lambda scene: aim_around(scene, SIZE, 12)[1],
    "from": lambda scene: aim_from(np.array((1.0, -2.5, 3.0)), np.array((1.0, 1.0, 0.2)), SIZE),
    "down": lambda scene: aim_from(np.array((1.0, 0.5, 4.0)), np.array((1.0, 0.5, 0.0)), SIZE),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_voxels_gaussians_and_names_agree_on_where_a_thing_is(name) -> None:
    red, blue = (210, 30, 30), (30, 30, 210)
    places = np.array(((0.2, 0.1, 0.3), (1.8, 1.0, 0.0)))
    scene = scene_of(quad(places[0], color=red), quad(places[1], color=blue))
    camera = CAMERAS[name](scene)
    expected, depth = pixels_of(places, camera)
    assert (depth > 0).all()
    voxels = render_scene(scene, camera)
    gaussians = Gaussians(
        places.astype(np.float32), np.full((2, 3), 0.08, np.float32), np.tile(np.float32((1, 0, 0, 0)), (2, 1)),
        np.ones(2, np.float32), np.array((red, blue), np.uint8), np.zeros(2, np.int32), places.astype(np.float32),
    )  # fmt: skip
    blobs = GaussianPainter(gaussians, np.eye(3)).draw(camera)
    for color, pixel in zip((red, blue), expected, strict=True):
        assert np.abs(middle_of(voxels, color) - pixel).max() < 2.5
        assert np.abs(middle_of(blobs, color) - pixel).max() < 1.5


def test_from_above_y_points_up_and_equal_lengths_look_equal() -> None:
    scene = scene_of(quad((0, 0, 0)), quad((3, 2, 2)))
    camera = aim(scene, "above", SIZE)
    low, high, lifted = pixels_of(np.array(((0, 0, 0), (1, 1, 0), (0, 0, 2.0))), camera)[0]
    assert high[0] > low[0]
    assert high[1] < low[1]
    assert np.abs(lifted - low).max() < 1


def test_a_box_is_in_the_view_however_far_off() -> None:
    far = DrawnBox(np.indices((2, 2, 2)).reshape(3, -1).T + (40.0, 0, 0), (0, 0, 0))
    pixels, _ = pixels_of(far.corners, aim(scene_of(quad((0, 0, 0)), boxes=(far,)), "corner", SIZE))
    assert (pixels >= 0).all()
    assert (pixels < SIZE).all()


def test_a_way_around_shows_all_of_the_scene_and_ends_where_it_began() -> None:
    scene = scene_of(quad((0, 0, 0)), quad((3, 0, 0)), quad((0, 2, 1)), quad((3, 2, 0)))
    cameras = aim_around(scene, SIZE, 36)
    spans = []
    for camera in cameras:
        pixels, depth = pixels_of(scene.vertices, camera)
        assert (depth > 0).all()
        assert (pixels > -2).all()
        assert (pixels < np.array(SIZE) + 2).all()
        spans.append(np.ptp(pixels[:, 0]))
    assert max(spans) > 0.6 * SIZE[0]
    steps = [
        np.linalg.norm(a.T_cam_scene - b.T_cam_scene) for a, b in zip(cameras, [*cameras[1:], cameras[0]], strict=True)
    ]
    assert max(steps) < 1.2 * min(steps)


def test_edges_of_boxes_are_drawn_also_around_the_camera() -> None:
    cube = np.indices((2, 2, 2)).reshape(3, -1).T - 0.5
    camera = aim_from(np.zeros(3), np.array((0.0, 1.0, 0.0)), SIZE)
    for edge, middle, seen in ((1.0, (0, 3, 0), True), (2.0, (0, 0.5, 0), True), (1.0, (0, -3, 0), False)):
        image = np.full((*SIZE[::-1], 3), 250, np.uint8)
        draw_edges(image, DrawnBox(edge * cube + middle, (200, 0, 0), ""), camera, 2)
        assert ((image == (200, 0, 0)).all(axis=2).sum() > 100) == seen
