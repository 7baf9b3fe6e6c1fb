"""Segmentation networks as encoders: every form of network, what is refused, and the words that match a class."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnx_models import COLORS, logits, write_classifier, write_identity, write_model
from small_captures import data_folder, models_folder

import freeocc3d
from freeocc3d.core.errors import ConfigError, FrameError, FreeOccError
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.editing import box_refinement
from freeocc3d.language.encoders import segmenter
from freeocc3d.language.encoders.segmenter import Options, SegmenterEncoder, SegmenterWords, load, load_text
from freeocc3d.pipeline import checks
from freeocc3d.settings import config

NAMES = ["void", "tomato", "lettuce", "bluebell"]
PLAIN: dict[str, Any] = {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0), "stride": 1}


def picture(height: int = 64, width: int = 96) -> NDArray[np.uint8]:
    """Four fields of the classes' colors, each of them large and a little off."""
    rows, columns = np.indices((height, width))
    number = 2 * (rows >= height // 2) + (columns >= width // 2)
    rng = np.random.default_rng(0)
    return np.clip(255 * COLORS[number] + rng.normal(0, 8, (height, width, 3)), 0, 255).astype(np.uint8)


def frame(color: NDArray[np.uint8]) -> Frame:
    height, width = color.shape[:2]
    return Frame(7, 0.0, color, np.ones((height, width), np.float32), Intrinsics(width, height, 50, 50, 40, 30))


def encoder(tmp_path: Path, names: list[str] | None = None, options: dict[str, Any] | None = None, **form: Any) -> Any:
    (tmp_path / "names.txt").write_text("\n".join(names or NAMES))
    write_classifier(tmp_path / "net.onnx", **form)
    given = {**PLAIN, "model": str(tmp_path / "net.onnx"), "classes": str(tmp_path / "names.txt"), **(options or {})}
    return load(Options(**given))


def expected(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Posteriors of a picture's pixels, void left out: plain NumPy."""
    scores = logits(color.astype(np.float32) / 255)
    odds = np.exp(scores - scores.max(axis=-1, keepdims=True))
    p = odds / odds.sum(axis=-1, keepdims=True)
    return np.where(p.argmax(axis=-1)[..., None] > 0, p[..., 1:], 0)


def test_features_are_posteriors(tmp_path: Path) -> None:
    made = encoder(tmp_path)
    features = made.encode(frame(picture()))
    assert features.dtype == np.float16
    assert made.dimension == 3
    np.testing.assert_allclose(features, expected(picture()), atol=2e-3)
    said = features.any(axis=2)
    assert 0.7 < said.mean() < 0.8  # all but the quarter that is void
    length = np.linalg.norm(features.astype(np.float32), axis=2)
    assert 0.5 < length[said].mean() < length.max() < 1  # how sure the network is


@pytest.mark.parametrize(
    "form",
    [
        {"image_last": True},
        {"classes_last": True},
        {"image_last": True, "classes_last": True},
        {"tail": "softmax"},
        {"dtype": TensorProto.UINT8},
        {"dtype": TensorProto.FLOAT16},
        {"size": (64, 96)},
    ],
)
def test_every_form_of_a_network_says_the_same(tmp_path: Path, form: dict[str, Any]) -> None:
    np.testing.assert_allclose(encoder(tmp_path, **form).encode(frame(picture())), expected(picture()), atol=5e-3)


def test_class_numbers_are_certain(tmp_path: Path) -> None:
    features = encoder(tmp_path, tail="argmax").encode(frame(picture()))
    assert set(np.unique(features)) == {0, 1}
    np.testing.assert_array_equal(features.argmax(axis=2), expected(picture()).argmax(axis=2))


def test_images_are_normalized_and_channels_put_in_order(tmp_path: Path) -> None:
    mean, std = (0.1, 0.2, 0.3), (0.5, 0.6, 0.7)
    color = picture()
    normalized = (color.astype(np.float32) / 255 - np.float32(mean)) / np.float32(std)
    for channels, given in (("rgb", normalized), ("bgr", normalized[..., ::-1])):
        made = encoder(tmp_path, options={"mean": mean, "std": std, "channels": channels})
        scores = made.network.posteriors(frame(color), *color.shape[:2])
        odds = np.exp(logits(given))
        np.testing.assert_allclose(scores, odds / odds.sum(axis=-1, keepdims=True), atol=1e-3)


def test_features_cover_the_image_whatever_the_sizes(tmp_path: Path) -> None:
    """Of the input, the output and the features: borders of fields stay where they are."""
    color = picture(128, 192)
    forms = ({"size": (64, 96)}, {"size": (128, 192), "shrink": 4}, {"size": ("h", "w")}, {"size": (96, 64)})
    for form in forms:
        for stride in (1, 4, 5):
            features = encoder(tmp_path, options={"stride": stride}, **form).encode(frame(color))
            assert features.shape == (-(-128 // stride), -(-192 // stride), 3)
            height, width = features.shape[:2]
            quarters = features[height // 8 :: height // 2, width // 8 :: width // 2][:2, :2].argmax(axis=2)
            np.testing.assert_array_equal(quarters, [[0, 0], [1, 2]])
            assert not features[height // 8, width // 8].any()
            red = (features.argmax(axis=2) == 0) & features.any(axis=2)
            assert red[: height // 2, width // 2 :].mean() > 0.85
            assert red[height // 2 :].mean() < 0.1


def test_a_free_input_takes_a_size_that_is_asked_for(tmp_path: Path) -> None:
    made = encoder(tmp_path, options={"size": (48, 32)})
    assert made.network._image(picture()).shape == (1, 3, 32, 48)
    assert encoder(tmp_path).network._image(picture(70, 90)).shape == (1, 3, 64, 96)


def test_void_classes_by_option(tmp_path: Path) -> None:
    made = encoder(tmp_path, options={"void": ("Tomato",)})
    assert made.classes == ("void", "lettuce", "bluebell")
    features = made.encode(frame(picture()))
    assert not features[5, 80].any()
    assert features[5, 5].argmax() == 0
    with pytest.raises(ConfigError, match=r"void class 'tomatoe' \(did you mean 'tomato'\?\) is not in"):
        encoder(tmp_path, options={"void": ("tomatoe",)})
    with pytest.raises(ConfigError, match="no class is left"):
        encoder(tmp_path, options={"void": tuple(NAMES)})


def test_posteriors_of_classes_that_are_mapped_to_one_are_added(tmp_path: Path) -> None:
    path = tmp_path / "mapping.yaml"
    path.write_text("classes: [plant, tomato, metal]\nmap: {void: null, lettuce: plant, bluebell: plant}\n")
    made = encoder(tmp_path, options={"mapping": str(path)})
    assert made.classes == ("plant", "tomato")  # the network knows no metal
    features = made.encode(frame(picture())).astype(np.float32)
    whole = expected(picture())
    added = np.stack((whole[..., 1:].sum(axis=-1), whole[..., 0]), axis=-1)
    np.testing.assert_allclose(features, added, atol=3e-3)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("classes: [plant]\nmap: {void: null, lettuce: plant, bluebell: plant}", "what 'tomato' becomes"),
        ("classes: [plant]\nmap: {void: stone}", "'stone', which is not one"),
        ("map: {void: null}", "must hold 'classes'"),
        ("classes: plant", "a list of names"),
        ("- plant", "becomes"),
        ("classes: [plant]\nmap: [void]", "must hold lines of the form 'name: class'"),
        ("classes: [", "not valid YAML"),
    ],
)
def test_broken_mappings_are_reported(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "mapping.yaml"
    path.write_text(text)
    with pytest.raises(FreeOccError, match=told):
        encoder(tmp_path, options={"mapping": str(path)})


def refused(tmp_path: Path, path: Path, told: str, **options: Any) -> None:
    (tmp_path / "names.txt").write_text("\n".join(NAMES))
    with pytest.raises(FreeOccError, match=told) as caught:
        load(Options(**{"model": str(path), "classes": str(tmp_path / "names.txt"), **options}))
    assert "\n" not in str(caught.value)


def test_files_that_are_no_networks_are_reported(tmp_path: Path) -> None:
    refused(tmp_path, tmp_path / "absent.onnx", "There is no file .*language.segmenter.model")
    refused(tmp_path, tmp_path, "There is no file .*language.segmenter.model")
    (tmp_path / "text.onnx").write_text("not a network")
    refused(tmp_path, tmp_path / "text.onnx", "ONNX")
    (tmp_path / "empty.onnx").write_bytes(b"")
    refused(tmp_path, tmp_path / "empty.onnx", "ONNX")
    whole = write_classifier(tmp_path / "net.onnx").read_bytes()
    (tmp_path / "half.onnx").write_bytes(whole[: len(whole) // 2])
    refused(tmp_path, tmp_path / "half.onnx", "ONNX")


@pytest.mark.parametrize(
    ("shape", "dtype", "inputs"),
    [
        ([1, 1, 8, 8], TensorProto.FLOAT, 1),
        ([1, 4, 8, 8], TensorProto.FLOAT, 1),
        ([3, 8, 8], TensorProto.FLOAT, 1),
        ([1, 10], TensorProto.FLOAT, 1),
        ([1, 3, 8, 8], TensorProto.INT64, 1),
        ([1, 3, 8, 8], TensorProto.FLOAT, 2),
    ],
)
def test_networks_of_other_inputs_are_reported(tmp_path: Path, shape: list[int], dtype: int, inputs: int) -> None:
    path = write_identity(tmp_path / "net.onnx", shape, dtype, inputs)
    refused(tmp_path, path, "does not take one RGB image")


def test_networks_that_fit_neither_classes_nor_sizes_are_reported(tmp_path: Path) -> None:
    net = write_classifier(tmp_path / "net.onnx", size=(64, 96))
    refused(tmp_path, write_identity(tmp_path / "three.onnx", [1, 3, 8, 8]), r"names 4 classes.*out \(1, 3, 8, 8\)")
    refused(tmp_path, write_identity(tmp_path / "two.onnx", [2, 3, 8, 8]), "takes 2 images at once")
    refused(tmp_path, net, r"takes only images of 96 x 64", size=(64, 64))
    refused(tmp_path, net, "no output 'scores'", output="scores")
    refused(tmp_path, tmp_path / "", "set language.segmenter.model", model="")
    refused(tmp_path, net, "set language.segmenter.classes", classes="")
    refused(tmp_path, net, "cpu", device="tpu")
    refused(tmp_path, net, "There is no file .*language.segmenter.classes", classes=str(tmp_path / "absent.txt"))


def test_files_that_are_not_there_are_reported_before_any_work(tmp_path: Path) -> None:
    settings = {"language": {"encoder": "segmenter", "segmenter": {"model": str(tmp_path / "absent.onnx")}}}
    with pytest.raises(ConfigError, match=r"absent\.onnx: correct language\.segmenter\.model"):
        checks.check(config.resolve(settings))


def test_what_shapes_leave_open_is_reported_before_there_is_work_to_lose(tmp_path: Path) -> None:
    open_ = write_identity(tmp_path / "net.onnx", [1, "channels", "height", "width"])
    refused(tmp_path, open_, r"names 4 classes.*\(1, 3, 64, 64\)")
    shape = numpy_helper.from_array(np.array([1, 4, 10, 10]), "shape")
    node = helper.make_node("Reshape", ["image", "shape"], ["out"])
    info = [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])]
    info.append(helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, 4, "h", "w"]))
    refused(tmp_path, write_model(tmp_path / "net.onnx", [node], info[:1], info[1:], [shape]), r"\(1, 3, 64, 64\)")
    few = encoder(tmp_path, names=["void", "tomato"], tail="argmax")
    with pytest.raises(ConfigError, match="gives class 3, but only 2"):
        few.encode(frame(picture()))


def test_numbers_that_are_not_finite_cost_a_frame(tmp_path: Path) -> None:
    """Where black is divided by itself."""
    (tmp_path / "names.txt").write_text("void\na\nb")
    one = helper.make_node("Div", ["image", "image"], ["out"])
    info = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3, 64, 96]) for name in ("image", "out")]
    path = write_model(tmp_path / "net.onnx", [one], info[:1], info[1:])
    made = load(Options(model=str(path), classes=str(tmp_path / "names.txt"), mean=(0, 0, 0)))
    with pytest.raises(FrameError, match="not finite for frame 7"):
        made.encode(frame(np.zeros((64, 96, 3), np.uint8)))


def test_the_output_with_a_channel_for_each_class_is_taken(tmp_path: Path) -> None:
    (tmp_path / "names.txt").write_text("\n".join(NAMES))
    weight = numpy_helper.from_array(np.ones((4, 3, 1, 1), np.float32), "weight")
    nodes = [helper.make_node("Identity", ["image"], ["low"]), helper.make_node("Conv", ["image", "weight"], ["high"])]
    info = {n: helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, c, 8, 8]) for n, c in
            (("image", 3), ("low", 3), ("high", 4))}  # fmt: skip
    path = write_model(tmp_path / "net.onnx", nodes, [info["image"]], [info["low"], info["high"]], [weight])
    given = {"model": str(path), "classes": str(tmp_path / "names.txt")}
    assert load(Options(**given)).network.output.name == "high"
    with pytest.raises(ConfigError, match="names 4 classes"):
        load(Options(**given, output="low"))


@pytest.mark.parametrize("bad", [{"stride": 0}, {"size": (0, 4)}, {"channels": "hsv"}, {"std": (1.0, 0.0, 1.0)}])
def test_options_out_of_range_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        Options(**bad)


def test_words_are_restored_from_plain_state(tmp_path: Path) -> None:
    made = encoder(tmp_path, names=["void", "sofa", "table", "lamp"])
    made.aliases = {"futon": 0}
    words = load_text(json.loads(json.dumps(made.text_state())))
    text = words.encode_words(["Couch", "a futon", "big red futons by the table", "unicorn", "coffee table"])
    assert text.understood == ("couch", "futon", "futon", "", "table")
    np.testing.assert_array_equal(text.features.argmax(axis=1)[[0, 1, 2, 4]], [0, 0, 0, 1])
    assert not text.features[3].any()
    assert words.contrast_words() == ["sofa", "table", "lamp"]


def test_the_longest_part_that_either_knows_is_used() -> None:
    words = SegmenterWords(["table", "lamp", "bed"], {"pooltable": 2, "lamp": 0})
    assert words.matching("pool table") == ([2], "pool table")
    assert words.matching("coffee table") == ([0], "table")
    assert words.matching("lamp") == ([1], "lamp")  # a class of the very name comes first


def test_a_real_network_on_real_pictures(tmp_path: Path) -> None:
    """Classes of the kitchen, seen from where the table fills the lower half of the image."""
    models = models_folder()
    made = load(
        Options(
            model=str(models / "enet_nyu40.onnx"), classes=str(models / "nyu40.txt"),
            embeddings=str(models / "clip_text_names.npz"), mean=(0.496342, 0.466664, 0.440796),
            std=(0.277856, 0.28623, 0.291129),
        )
    )  # fmt: skip
    assert isinstance(made, SegmenterEncoder)
    assert made.dimension == 40
    bgr = cv2.imread(str(data_folder() / "7scenes-kitchen" / "frame-000400.color.jpg"))
    features = made.encode(frame(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)))
    assert features.shape == (120, 160, 40)
    words = load_text(made.text_state())
    table = words.encode_words(["dining table"]).features[0]
    score = features.astype(np.float32) @ table
    assert score[70:].mean() > 0.7
    assert score[:20].mean() < 0.4
    np.testing.assert_array_equal(words.encode_words(["backpack"]).features, words.encode_words(["bag"]).features)
    assert segmenter.NEEDS_CAPTURE is False


def test_a_map_of_a_networks_classes_is_asked_and_refined_without_its_capture(tmp_path: Path) -> None:
    (tmp_path / "names.txt").write_text("void\nred thing\ngreen thing\nblue thing")
    net = write_classifier(tmp_path / "net.onnx")
    settings = {
        "capture": {"synthetic": {"width": 160, "height": 120}, "stop": 16},
        "fitting": {"passes": 0},
        "language": {
            "encoder": "segmenter",
            "segmenter": {**PLAIN, "model": str(net), "classes": str(tmp_path / "names.txt")},
        },
    }
    made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", settings)
    by_color = freeocc3d.reconstruct("builtin:room", tmp_path / "colours", {**settings, "language": {}})
    red = made.query_words(["red thing"], objects=False)[0]  # the nearest whole object differs: color is a stand-in
    assert red.matched
    seen = by_color.query("red").regions[0]
    assert np.linalg.norm(red.regions[0].centroid - seen.centroid) < 0.3
    nothing = made.query("purple unicorn")
    assert not nothing.matched
    assert "red thing" in nothing.note
    box = box_refinement.enclose_region(red.regions[0], 0.08)
    assert box_refinement.refine_box(made, box, 0.04, tmp_path / "refined").query("red thing").matched
