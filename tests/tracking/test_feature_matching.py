"""Matches of local features, which pairs of images are compared, and the features themselves."""

from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from freeocc3d.core.errors import ModelError
from freeocc3d.tracking.sfm import pair_selection
from freeocc3d.tracking.sfm.feature_matching import _nearest, _nearest_reference, match_descriptors
from freeocc3d.tracking.sfm.local_features import Sift, load_detector


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def test_the_kernel_finds_what_its_reference_finds() -> None:
    rng = np.random.default_rng(0)
    for shape in ((40, 70), (70, 40), (2, 2)):
        cosines = rng.uniform(-1, 1, shape).astype(np.float32)
        for got, expected in zip(_nearest(cosines), _nearest_reference(cosines), strict=True):
            np.testing.assert_array_equal(got, expected)


def test_matches_are_mutual_and_unrivalled() -> None:
    rng = np.random.default_rng(1)
    a = unit(rng.normal(size=(30, 64)))
    order = rng.permutation(30)
    b = unit(a[order] + 0.02 * rng.normal(size=a.shape))
    rows = match_descriptors(a, b, 0.8)
    assert len(rows) == 30
    np.testing.assert_array_equal(order[rows[:, 1]], rows[:, 0])
    doubled = np.concatenate((b, unit(b[:1] + 0.001)))  # now two are as near to one
    assert order[0] not in match_descriptors(a, doubled, 0.8)[:, 0]
    assert order[0] in match_descriptors(a, doubled, 1.0)[:, 0]
    assert len(match_descriptors(a, b[:1], 0.8)) == 0


def images_on_a_line(count: int) -> list[np.ndarray]:
    """Descriptors of images in a row: each shares most of its content with the next, and the last image is the first
    one again."""
    rng = np.random.default_rng(2)
    world = unit(rng.normal(size=(40 * count + 160, 32)))
    images = [world[40 * n : 40 * n + 160] for n in range(count)]
    return [*images[:-1], images[0]]


def test_a_video_is_distinguished_from_photographs_and_loops_are_proposed() -> None:
    alike = pair_selection.compare_images(images_on_a_line(40))
    assert pair_selection.is_sequence(alike)
    mixed = np.random.default_rng(3).permutation(40)
    assert not pair_selection.is_sequence(alike[mixed][:, mixed])
    pairs = {tuple(pair) for pair in pair_selection.choose_pairs(alike, 2, 2).tolist()}
    assert {(n, n + 1) for n in range(39)} | {(n, n + 2) for n in range(38)} <= pairs
    assert (0, 39) in pairs
    assert all(i < j for i, j in pairs)
    assert len(pair_selection.choose_pairs(alike, 0, 39)) == 40 * 39 // 2


def test_sift_puts_features_where_things_are() -> None:
    image = np.full((120, 160, 3), 60, np.uint8)
    cv2.circle(image, (50, 40), 5, (240, 240, 240), -1, cv2.LINE_AA)
    found = Sift()(image)
    assert found.descriptors.dtype == np.uint8
    assert np.linalg.norm(found.pixels - (50, 40), axis=1).min() < 0.15
    large = np.full((1500, 2000, 3), 60, np.uint8)
    cv2.circle(large, (900, 700), 8, (240, 240, 240), -1, cv2.LINE_AA)
    assert np.linalg.norm(Sift()(large).pixels - (900, 700), axis=1).min() < 0.3


def write_detector(path: Path, size: tuple[int, int] = (120, 160), described: str = "descriptors") -> Path:
    """A network whose keypoints are the 50 strongest responses of a Laplacian, described by the patch around."""
    height, width = size
    laplacian = np.array([[-1, -1, -1], [-1, 8, -1], [-1, -1, -1]], np.float32).reshape(1, 1, 3, 3)
    patch = np.eye(81, dtype=np.float32).reshape(81, 1, 9, 9)
    constants = {
        "laplacian": laplacian, "patch": patch, "flat": np.array([-1], np.int64), "k": np.array([50], np.int64),
        "rows": np.array([81, -1], np.int64), "width": np.array(width, np.int64),
        "margin": np.array([0, 0, 1, 1, 0, 0, 1, 1], np.int64),
    }  # fmt: skip
    nodes = [
        helper.make_node("Pad", ["image", "margin"], ["padded"], mode="edge"),
        helper.make_node("Conv", ["padded", "laplacian"], ["response"]),
        helper.make_node("MaxPool", ["response"], ["peak"], kernel_shape=[5, 5], pads=[2, 2, 2, 2], strides=[1, 1]),
        helper.make_node("Equal", ["response", "peak"], ["is_peak"]),
        helper.make_node("Cast", ["is_peak"], ["mask"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["response", "mask"], ["corners"]),
        helper.make_node("Reshape", ["corners", "flat"], ["scores"]),
        helper.make_node("TopK", ["scores", "k"], ["best", "at"]),
        helper.make_node("Mod", ["at", "width"], ["u"]),
        helper.make_node("Div", ["at", "width"], ["v"]),
        helper.make_node("Cast", ["u"], ["x"], to=TensorProto.FLOAT),
        helper.make_node("Cast", ["v"], ["y"], to=TensorProto.FLOAT),
        helper.make_node("Unsqueeze", ["x", "flat"], ["x1"]),
        helper.make_node("Unsqueeze", ["y", "flat"], ["y1"]),
        helper.make_node("Concat", ["x1", "y1"], ["keypoints"], axis=1),
        helper.make_node("Conv", ["image", "patch"], ["patches"], pads=[4, 4, 4, 4]),
        helper.make_node("Reshape", ["patches", "rows"], ["columns"]),
        helper.make_node("Gather", ["columns", "at"], ["gathered"], axis=1),
        helper.make_node("ReduceMean", ["gathered"], ["mean"], axes=[0], keepdims=1),
        helper.make_node("Sub", ["gathered", "mean"], ["centered"]),
        helper.make_node("Transpose", ["centered"], [described], perm=[1, 0]),
    ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, height, width])
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in ("keypoints", described)]
    weights = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    model = helper.make_model(
        helper.make_graph(nodes, "corners", [image], outputs, weights), opset_imports=[helper.make_opsetid("", 13)]
    )
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


def test_features_of_a_network_match_between_shifted_images(tmp_path: Path) -> None:
    detect = load_detector(str(write_detector(tmp_path / "corners.onnx")))
    rng = np.random.default_rng(4)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (140, 180), np.uint8), (0, 0), 1.5)
    first, second = (np.repeat(texture[y : y + 120, x : x + 160, None], 3, 2) for y, x in ((0, 0), (6, 10)))
    a, b = detect(first), detect(second)
    assert a.descriptors.dtype == np.float32
    rows = match_descriptors(a.descriptors, b.descriptors, detect.ratio)
    moved = a.pixels[rows[:, 0]] - b.pixels[rows[:, 1]]
    assert (np.abs(moved - (10, 6)).max(axis=1) < 0.5).sum() > 25


def test_networks_that_find_no_features_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no network"):
        load_detector(str(tmp_path / "missing.onnx"))
    with pytest.raises(ModelError, match="keypoints and descriptors"):
        load_detector(str(write_detector(tmp_path / "other.onnx", described="logits")))
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(ModelError, match="not an ONNX network"):
        load_detector(str(tmp_path / "text.onnx"))
