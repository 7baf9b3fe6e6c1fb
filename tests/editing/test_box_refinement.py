"""Finer voxels in a box: the paper's cups, one lump at 8 cm and two cups at 5 mm."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import refused, run
from msgspec import structs

from freeocc3d.capture.builtin.builtin_room import CUP_HEIGHT, CUPS
from freeocc3d.core.errors import MapError
from freeocc3d.core.progress import Progress
from freeocc3d.core.transforms import invert, transform
from freeocc3d.core.types import FREE
from freeocc3d.editing import box_refinement
from freeocc3d.language.encoders import color
from freeocc3d.occupancy.connected_components import label_components
from freeocc3d.query.scan_map import Map

RED, YELLOW = (np.array(CUPS[name]) + (0, 0, 0.5 * CUP_HEIGHT) for name in ("red", "yellow"))
"""Middles of the two cups, which stand on a table of 75 cm."""
MIDDLE, REACH = 0.5 * (RED + YELLOW), np.array((0.2, 0.2, 0.1))


@pytest.fixture(scope="module", autouse=True)
def _in_the_maps_frame(room: Map) -> None:
    """Moves the places of the cups into the frame of the room's map."""
    for place in (RED, YELLOW, MIDDLE):
        place[:] = transform(invert(np.array(room.manifest.T_world_map)), place)


@pytest.fixture(scope="module")
def cups(room: Map, tmp_path_factory) -> Map:
    box = box_refinement.Box(MIDDLE - REACH, MIDDLE + REACH)
    return box_refinement.refine_box(room, box, 0.005, tmp_path_factory.mktemp("refine") / "cups")


def near(found: Map, point: np.ndarray, radius: float) -> np.ndarray:
    voxels = found.occupancy.occupied_voxels()
    return voxels[np.linalg.norm(found.occupancy.centers(voxels) - point, axis=1) < radius]


def test_cups_that_are_one_lump_at_8_cm_are_two_regions_at_5_mm(room: Map, cups: Map) -> None:
    lump = near(room, MIDDLE, 0.2)
    assert len(np.unique(label_components(lump))) == 1
    for word, middle in (("red cup", RED), ("yellow cup", YELLOW)):
        best = cups.query(word).regions[0]
        assert np.linalg.norm(best.centroid[:2] - middle[:2]) < 0.015
        assert best.box_min[2] > 0.74
        size = best.box_max - best.box_min
        assert (size > 0.05).all()
        assert (size < 0.13).all()
        large = [region for region in cups.query(word).regions if region.voxels > 50]
        assert len(large) == 1


def test_between_and_above_the_cups_it_is_free(cups: Map) -> None:
    centers = cups.occupancy.centers(cups.occupancy.voxels(FREE))
    for point in (MIDDLE, MIDDLE + (0, 0, 0.08)):
        assert np.linalg.norm(centers - point, axis=1).min() < 0.005


def test_surfaces_are_where_they_are_to_a_voxel(cups: Map) -> None:
    """The table's top, away from the cups."""
    voxels = cups.occupancy.occupied_voxels()
    centers = cups.occupancy.centers(voxels)
    away = (np.abs(centers[:, 1] - MIDDLE[1]) > 0.12) & (centers[:, 2] > 0.72)
    assert away.sum() > 500
    assert abs(np.median(centers[away, 2]) - 0.75) < 0.005
    assert centers[away, 2].max() < 0.765


def test_what_is_refined_is_a_map_that_can_be_refined_again(cups: Map) -> None:
    again = box_refinement.refine_box(cups, box_refinement.Box(RED - 0.06, RED + 0.06), 0.004, cups.path.parent / "red")
    assert again.manifest.voxel_size_m == 0.004
    assert again.query("red cup").regions[0].volume_m3 > 1e-5
    assert again.manifest.refined.map.endswith("cups")
    assert len(again.keyframes) <= len(cups.keyframes)
    assert len(again.gaussians) == again.manifest.counts.gaussians


def test_boxes_that_cannot_be_refined(room: Map, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="lower and an upper corner"):
        box_refinement.Box(np.ones(3), np.zeros(3))
    with pytest.raises(MapError, match="No keyframe"):
        box_refinement.refine_box(room, box_refinement.Box(np.full(3, 50.0), np.full(3, 50.5)), 0.01, tmp_path / "map")
    with pytest.raises(MapError, match="which are too many"):
        box_refinement.refine_box(room, box_refinement.Box(np.full(3, -50.0), np.full(3, 50.0)), 0.01, tmp_path / "map")
    with pytest.raises(MapError, match="are not possible"):
        box_refinement.refine_box(room, box_refinement.Box(np.zeros(3), np.ones(3)), 0.2, tmp_path / "map")
    with pytest.raises(MapError, match="cannot replace it"):
        box_refinement.refine_box(
            room, box_refinement.Box(MIDDLE - REACH, MIDDLE + REACH), 0.01, room.path, overwrite=True
        )
    in_the_air = MIDDLE + (0, 0, 0.5)
    with pytest.raises(MapError, match=r"No keyframe|No voxel"):
        box_refinement.refine_box(
            room, box_refinement.Box(in_the_air - 0.05, in_the_air + 0.05), 0.01, tmp_path / "map"
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("needed", [False, True])
def test_a_map_that_has_moved_to_another_machine(room: Map, needed: bool, tmp_path: Path, monkeypatch) -> None:
    """Colors are found in the keyframes; where an encoder needs the capture, features are the map's own."""
    monkeypatch.setattr(color, "NEEDS_CAPTURE", needed)
    told = []
    progress = Progress()
    progress.warn = told.append  # type: ignore[method-assign]
    moved = Map(room.path, structs.replace(room.manifest, capture=structs.replace(room.manifest.capture, path="/gone")))
    found = box_refinement.refine_box(
        moved, box_refinement.Box(MIDDLE - REACH, MIDDLE + REACH), 0.01, tmp_path / "map", progress=progress
    )
    assert len(told) == needed
    assert not told or "cannot be loaded" in told[0]
    assert found.occupancy.features.shape == (len(found.occupancy.colors), room.occupancy.features.shape[1])


def test_from_the_command_line(room: Map, tmp_path: Path) -> None:
    low, high = (MIDDLE - REACH).tolist(), (MIDDLE + REACH).tolist()
    done = run("refine", room.path, "--box", *low, *high, "--voxel", 0.01, "-o", tmp_path / "map")
    assert "edge 0.01 m" in done.stdout
    assert f"a box of {room.path}" in done.stdout
    assert "exists" in refused("refine", room.path, "--box", *low, *high, "--voxel", 0.01, "-o", tmp_path / "map")
    word = "red cup"
    coarse = json.loads(run("query", room.path, word, "--json").stdout)["results"][0]["regions"][0]
    fine = json.loads(run("query", room.path, word, "--refine", 0.02, "--json").stdout)["results"][0]["regions"][0]
    assert np.linalg.norm(np.subtract(fine["centroid"], coarse["centroid"])) < 1.0
    assert fine["voxels"] > coarse["voxels"]
    picture = tmp_path / "cups.png"
    run("query", room.path, word, "--refine", 0.02, "--picture", picture, "--ply", tmp_path / "cups.ply")
    assert picture.stat().st_size > 10_000
    assert "one word" in run("query", room.path, word, "sofa", "--refine", 0.02, code=2).stderr
    assert "-o keeps" in run("query", room.path, word, "-o", tmp_path / "other", code=2).stderr
