"""Packets, and what of a map goes into them."""

from __future__ import annotations

import gzip
import json
from typing import Any

import numpy as np
import pytest
from labeled_rooms import labeled_room
from numpy.typing import NDArray

from freeocc3d.core.errors import MapError
from freeocc3d.core.types import FREE, OCCUPIED, UNKNOWN, Occupancy
from freeocc3d.query.scan_map import Map
from freeocc3d.viewer.browser import scene_arrays
from freeocc3d.viewer.browser.packets import compress, pack
from freeocc3d.viewer.browser.scene_arrays import describe_scene, describe_space

NUMPY = {"Uint8Array": "<u1", "Uint16Array": "<u2", "Uint32Array": "<u4", "Int8Array": "<i1", "Int16Array": "<i2",
         "Int32Array": "<i4", "Float32Array": "<f4"}  # fmt: skip


def unpack(packet: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """What the page reads: a plain reader of the layout."""
    length = int.from_bytes(packet[:4], "little")
    header = json.loads(packet[4 : 4 + length])
    start = -(-(4 + length) // 8) * 8
    arrays = {}
    for name, about in header["arrays"].items():
        kind = np.dtype(NUMPY[about["type"]])
        assert (start + about["at"]) % kind.itemsize == 0, "a typed array would not accept this place"
        count = int(np.prod(about["shape"]))
        arrays[name] = np.frombuffer(packet, kind, count, start + about["at"]).reshape(about["shape"])
    return header["meta"], arrays


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return labeled_room(tmp_path_factory)


def test_a_packet_holds_what_was_packed() -> None:
    rng = np.random.default_rng(0)
    kinds = ("uint8", "uint16", "uint32", "int8", "int16", "int32", "float32")
    arrays = {f"{kind}-{n}": (100 * rng.random((n, 3))).astype(kind) for kind in kinds for n in (0, 1, 5)}
    meta, read = unpack(gzip.decompress(compress(pack({"a": [1, "é"]}, arrays))))
    assert meta == {"a": [1, "é"]}
    assert {name: array.tolist() for name, array in read.items()} == {k: v.tolist() for k, v in arrays.items()}


def test_other_types_and_numbers_that_are_not_finite_are_refused() -> None:
    with pytest.raises(KeyError):
        pack({}, {"a": np.zeros(1)})
    with pytest.raises(ValueError, match="JSON"):
        pack({"a": float("nan")}, {})


def test_a_scene_puts_each_voxel_where_it_is(room: Map) -> None:
    meta, arrays = unpack(pack(*describe_scene(room)))
    occupancy, voxels = room.occupancy, arrays["voxels"].astype(np.float64)
    centers = np.array(meta["voxels"]["origin"]) + meta["voxels"]["unit"] * (voxels[:, :3] + 0.5 * voxels[:, 3:])
    np.testing.assert_allclose(centers, occupancy.centers(occupancy.occupied_voxels()), atol=1e-9)
    assert arrays["colors"].tolist() == occupancy.colors.tolist()
    assert arrays["classes"].tolist() == room.labels().tolist()
    block, local = np.nonzero(occupancy.state == OCCUPIED)
    assert arrays["hits"].tolist() == occupancy.hits[block, local].tolist()
    assert sum(each["voxels"] for each in meta["classes"]) == len(voxels)
    assert len(meta["keyframes"]) == len(arrays["cameras"]) == len(room.keyframes)
    np.testing.assert_allclose(arrays["means"], room.gaussians.means)


def test_only_the_largest_gaussians_are_drawn_if_there_are_too_many(room: Map) -> None:
    meta, arrays = describe_scene(room, most_gaussians=100)
    assert meta["gaussians"] == {"drawn": 100, "all": len(room.gaussians)}
    area = np.sort(arrays["scales"], axis=1)[:, 1:].prod(axis=1) * arrays["opacities"]
    every = np.sort(room.gaussians.scales, axis=1)[:, 1:].prod(axis=1) * 255 * room.gaussians.opacities
    assert area.min() >= 0.99 * np.sort(every)[-100]


def test_space_holds_every_free_voxel_and_unknown_ones_beside_them(room: Map) -> None:
    _, arrays = describe_space(room)
    occupancy = room.occupancy
    assert len(arrays["free"]) == len(occupancy.voxels(FREE))
    free = {tuple(voxel) for voxel in arrays["free"][:, :3].tolist()}
    sides = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    for i, j, k, _ in arrays["unknown"][:50].tolist():
        assert any((i + a, j + b, k + c) in free for a, b, c in sides)
    low = scene_arrays._lowest(occupancy)
    unknown = {tuple(voxel) for voxel in (occupancy.voxels(UNKNOWN) - low).tolist()}
    expected = {u for u in unknown if any((u[0] + a, u[1] + b, u[2] + c) in free for a, b, c in sides)}
    assert {tuple(voxel) for voxel in arrays["unknown"][:, :3].tolist()} == expected


def test_voxels_of_several_sizes_have_their_edges() -> None:
    state = np.full((2, 512), UNKNOWN, np.uint8)
    state[:, 0] = OCCUPIED
    plain = np.zeros((2, 512), np.uint16)
    made = Occupancy(0.08, np.zeros(3), np.array(((0, 0, 0), (4, 0, 0)), np.int32), plain.astype(np.float32), plain,
                     plain, state, colors=np.zeros((2, 3), np.uint8), levels=np.array((0, 1), np.uint8))  # fmt: skip
    low = scene_arrays._lowest(made)
    packed = scene_arrays._packed(made.occupied_voxels(), made.occupied_edges(), low)
    assert packed[:, 3].tolist() == [2, 1]
    np.testing.assert_array_equal(packed[:, :3] + low, made.occupied_voxels())


def test_a_map_that_reaches_too_far_is_refused() -> None:
    state = np.full((2, 512), OCCUPIED, np.uint8)
    plain = np.zeros((2, 512), np.uint16)
    made = Occupancy(0.01, np.zeros(3), np.array(((0, 0, 0), (5000, 0, 0)), np.int32), plain.astype(np.float32), plain,
                     plain, state)  # fmt: skip
    with pytest.raises(MapError, match="reaches over 40,007 voxels"):
        scene_arrays._lowest(made)
