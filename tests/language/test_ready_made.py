"""Ready-made ONNX exports become model packages: against the same network in PyTorch, at sizes of no training image."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import ready_made
import tiny_models
import torch
from onnx import TensorProto, helper
from torch import nn

from freeocc3d.core.errors import ModelError
from freeocc3d.language import clip_attention
from freeocc3d.language.encoders import clip, dinov2
from freeocc3d.language.model_export import transformer_graphs as graphs
from freeocc3d.language.patch_features import Tiling
from freeocc3d.language.ready_made import onnx_graphs
from freeocc3d.language.ready_made.export_packages import package_of_export
from freeocc3d.language.text_networks import TextNetwork

TOLERANCE = {"fp32": 1e-3, "fp16": 5e-3, "int8": 0.05}
TEXTS = ["a photo of a red chair.", "the table by the window"]


@pytest.fixture
def clip_export(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ready_made.copy_export(tmp_path_factory, tmp_path / "export", "clip", "fp32", "sdpa")


def in_torch(kind: str, images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, N, D) features of patches with naclip's and sclip's attention."""
    model = ready_made.model_of(kind)
    trunk = graphs.ImageTrunk(model.vision_model)
    head = (graphs.ClipHead if kind == "clip" else graphs.SiglipHead)(model)
    with torch.no_grad():
        q, k, v, stream = trunk(torch.from_numpy(images))
        grid = images.shape[2] // 8, images.shape[3] // 8
        mixed = [clip_attention.mix_values(own, *(x.numpy() for x in (q, k, v)), grid) for own in ("naclip", "sclip")]
        reduced, features = head(torch.from_numpy(mixed[0]), stream)[1], head(torch.from_numpy(mixed[1]), stream)[0]
    return reduced.numpy(), features.numpy()


def unit(features: np.ndarray) -> np.ndarray:
    return features / np.linalg.norm(features, axis=-1, keepdims=True)


@pytest.mark.parametrize("precision", ["fp32", "fp16", "int8"])
@pytest.mark.parametrize(("kind", "attention"), [("clip", "sdpa"), ("siglip", "eager")])
def test_an_export_equals_its_network(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, kind: str, attention: str, precision: str
) -> None:
    folder = ready_made.copy_export(tmp_path_factory, tmp_path / "export", kind, precision, attention)
    package, lacks = package_of_export(folder, tmp_path / "tiny", "someone/tiny", precision)
    assert (package.kind, package.precision, package.patch, package.licence) == ("clip", precision, 8, "mit")
    assert (package.prefix_tokens, lacks) == (int(kind == "clip"), "")
    assert package.mean == (0.5, 0.4, 0.3)
    assert package.logit_scale == (100.0 if kind == "clip" else 117.3308)
    images = np.random.default_rng(0).normal(size=(2, 3, 40, 24)).astype(np.float32)
    tiling = Tiling((5, 3), (5, 3), (0,), (0,), 8)
    image = onnx.load(package.folder / "image.onnx").graph
    weights = {own.name: own.data_type for own in image.initializer}
    kinds = {weights[node.input[1]] for node in image.node if node.op_type == "MatMulInteger"}
    fast = TensorProto.INT8 if onnx_graphs._int8_is_exact() else TensorProto.UINT8
    assert kinds == ({fast} if precision == "int8" else set())
    for replaced, reference in zip(("naclip", "sclip"), in_torch(kind, images), strict=True):
        encoder = clip.load(clip.Options(model=str(package.folder), attention=replaced))
        found = encoder._window_features(images, tiling).reshape(2, 15, -1)
        assert np.linalg.norm(unit(found) - unit(reference[:, -15:]), axis=-1).max() < TOLERANCE[precision]
    text = TextNetwork(package)
    model = ready_made.model_of(kind)
    with torch.no_grad():
        words = ready_made.Text(model)(torch.from_numpy(text.tokens(TEXTS)))
    words = (words if kind == "clip" else words[1]).numpy()
    assert np.linalg.norm(text.embed(TEXTS) - unit(words), axis=-1).max() < TOLERANCE[precision]
    assert (text.tokens(TEXTS).shape[1] == ready_made.LENGTH[kind]) == (kind == "siglip")


def changed(path: Path, change: Any) -> None:
    model = onnx.load(path)
    change(model.graph)
    onnx.save(model, path)


def without_softmax(graph: Any) -> None:
    """Writes each softmax as its parts, which nobody recognizes."""
    nodes = []
    for node in graph.node:
        if node.op_type != "Softmax":
            nodes.append(node)
            continue
        (x,), (y,) = node.input, node.output
        nodes.append(helper.make_node("Exp", [x], [f"{y}/exp"]))
        nodes.append(helper.make_node("ReduceL1", [f"{y}/exp"], [f"{y}/sum"], axes=[-1]))
        nodes.append(helper.make_node("Div", [f"{y}/exp", f"{y}/sum"], [y]))
    del graph.node[:]
    graph.node.extend(nodes)


def test_a_graph_that_cannot_be_cut_encodes_windows(clip_export: Path, tmp_path: Path) -> None:
    changed(clip_export / "onnx" / "vision_model.onnx", without_softmax)
    package, lacks = package_of_export(clip_export, tmp_path / "tiny", "someone/tiny", "fp32")
    assert package.kind == "windows"
    assert "vision_model.onnx cannot be cut, because it has no row of equal blocks with attention" in lacks
    assert "one feature to a window of 32 pixels instead of one to each patch" in lacks
    encoder = clip.load(clip.Options(model=str(package.folder), stride=0, short_side=32))
    frame = tiny_models.frame(32, 48)
    found = encoder.encode(frame).astype(np.float32)
    assert found.shape == (2, 3, 24)
    normal = (frame.color / np.float32(255) - np.array(package.mean, np.float32)) / np.array(package.std, np.float32)
    left = torch.from_numpy(normal.transpose(2, 0, 1)[None, :, :, :32].astype(np.float32))
    with torch.no_grad():
        expected = unit(ready_made.Vision(ready_made.model_of("clip"))(left).numpy())[0]
    assert np.linalg.norm(found[0, 0] - expected) < 2e-3


class ConvolutionalVision(nn.Module):
    """As MobileCLIP's: convolutions, one weighted by averages, then a projected average; fixed: attends to its cells as
    if there were always 16."""

    def __init__(self, fixed: bool) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.fixed = fixed
        self.stem, self.mix = nn.Conv2d(3, 12, 8, 8), nn.Conv2d(12, 12, 3, padding=1)
        self.gate, self.project = nn.Conv2d(12, 12, 1), nn.Linear(12, 24, bias=False)

    def cells(self, pixel_values: torch.Tensor) -> torch.Tensor:
        x = torch.relu(self.stem(pixel_values))
        x = self.mix(x) * torch.sigmoid(self.gate(x.mean(dim=(2, 3), keepdim=True)))
        if self.fixed:
            y = x.reshape(-1, 12, 16)
            x = (y @ torch.softmax(y.transpose(1, 2) @ y, dim=-1)).reshape(-1, 12, 4, 4)
        return x

    def forward(self, pixel_values: torch.Tensor) -> torch.Tensor:
        return self.project(self.cells(pixel_values).mean(dim=(2, 3)))


@pytest.mark.parametrize("fixed", [False, True])
def test_a_convolutional_network_gives_a_feature_to_each_cell(clip_export: Path, tmp_path: Path, fixed: bool) -> None:
    own = ConvolutionalVision(fixed).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            own, (torch.zeros(2, 3, 32, 32),), str(clip_export / "onnx" / "vision_model.onnx"), dynamo=False,
            input_names=["pixel_values"], output_names=["image_embeds"], opset_version=14,
            dynamic_axes={"pixel_values": {0: "batch"}, "image_embeds": {0: "batch"}},
        )  # fmt: skip
    package, lacks = package_of_export(clip_export, tmp_path / "tiny", "someone/tiny", "fp32")
    assert (package.kind, package.dimension, package.patch, lacks) == ("dense", 24, 8, "")
    height = 32 if fixed else 48
    images = np.random.default_rng(0).normal(size=(2, 3, height, 32)).astype(np.float32)
    (found,) = package.session("image").run(["features"], {"image": images})
    with torch.no_grad():
        expected = own.project(own.cells(torch.from_numpy(images)).permute(0, 2, 3, 1)).numpy()
        embedded = own(torch.from_numpy(images)).numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(found.mean(axis=(1, 2)), embedded, atol=1e-5)
    encoder = dinov2.load(dinov2.Options(model=str(package.folder), stride=0, short_side=40))
    assert encoder.encode(tiny_models.frame(40, 56)).shape == (5, 7, 24)


class BagOfTokens(nn.Module):
    """A text tower that sees what follows a text, as MobileCLIP's does."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.tokens = nn.Embedding(len(tiny_models.vocabulary()[0]), 24)

    def forward(self, input_ids: torch.Tensor) -> torch.Tensor:
        return self.tokens(input_ids).mean(dim=1)


def test_texts_are_as_long_as_in_training_where_padding_counts(clip_export: Path, tmp_path: Path) -> None:
    own = BagOfTokens()
    path = clip_export / "onnx" / "text_model.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            own, (torch.ones((2, 77), dtype=torch.int64),), str(path), dynamo=False, input_names=["input_ids"],
            output_names=["text_embeds"], dynamic_axes={"input_ids": {0: "batch", 1: "length"}}, opset_version=14,
        )  # fmt: skip
    settings = clip_export / "preprocessor_config.json"
    settings.write_text(json.dumps({**json.loads(settings.read_text()), "do_normalize": False}))
    (clip_export / "config.json").write_text(json.dumps({"model_type": "clip_vision_model"}))
    package, _ = package_of_export(clip_export, tmp_path / "tiny", "someone/tiny", "fp32")
    assert (package.mean, package.std) == ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    text = TextNetwork(package)
    tokens = text.tokens(TEXTS)
    assert tokens.shape == (2, 77)
    assert (tokens[:, -1] == 0).all()  # as OpenCLIP pads


def test_a_text_graph_may_list_an_image_and_a_mask(clip_export: Path, tmp_path: Path) -> None:
    plain, _ = package_of_export(clip_export, tmp_path / "plain", "someone/tiny", "fp32")

    def more(graph: Any) -> None:
        graph.input.append(helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, ["b", 3, 32, 32]))
        graph.input.append(helper.make_tensor_value_info("attention_mask", TensorProto.INT64, ["b", "l"]))
        masked = helper.make_node("Mul", ["input_ids", "attention_mask"], ["masked"])
        for node in graph.node:
            node.input[:] = ["masked" if name == "input_ids" else name for name in node.input]
        graph.node.insert(0, masked)

    changed(clip_export / "onnx" / "text_model.onnx", more)
    package, _ = package_of_export(clip_export, tmp_path / "tiny", "someone/tiny", "fp32")
    np.testing.assert_allclose(TextNetwork(package).embed(TEXTS), TextNetwork(plain).embed(TEXTS), atol=1e-6)


def rename_output(graph: Any) -> None:
    graph.output[0].name = "logits"
    graph.node[-1].output[0] = "logits"


def make_a_circle(graph: Any) -> None:
    graph.node[1].input[0] = graph.node[-1].output[0]


def rename_input(graph: Any) -> None:
    graph.input[0].name = "words"
    for node in graph.node:
        node.input[:] = ["words" if name == "input_ids" else name for name in node.input]


def keep_weights_outside(graph: Any) -> None:
    weight = graph.initializer[0]
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="../../secrets.bin")


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (
            "vision_model.onnx",
            rename_output,
            r"vision_model\.onnx of someone/tiny gives logits instead of image_embeds",
        ),
        (
            "vision_model.onnx",
            make_a_circle,
            r"vision graph of someone/tiny cannot be used: the nodes that make .* a circle",
        ),
        ("text_model.onnx", rename_output, r"text_model\.onnx of someone/tiny gives logits instead of text_embeds"),
        (
            "text_model.onnx",
            keep_weights_outside,
            r"keeps weights in '\.\./\.\./secrets\.bin', which is no file beside",
        ),
        (
            "text_model.onnx",
            rename_input,
            r"text_model\.onnx of someone/tiny cannot be used: it takes words instead of",
        ),
    ],
)
def test_graphs_of_another_kind_are_refused(
    clip_export: Path, tmp_path: Path, file: str, change: Any, message: str
) -> None:
    changed(clip_export / "onnx" / file, change)
    with pytest.raises(ModelError, match=message):
        package_of_export(clip_export, tmp_path / "tiny", "someone/tiny", "fp32")
    assert not (tmp_path / "tiny").exists()


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("config.json", json.dumps({"model_type": "bert"}), "is a model of type 'bert': clip and siglip can be used"),
        ("config.json", "[1]", "is not the configuration of a model that can be used"),
        ("tokenizer.json", "{}", r"tokenizer\.json is not a tokenizer\.json"),
        ("onnx/vision_model.onnx", "\x00\x01 none", "is not an ONNX network that can be read"),
    ],
)
def test_files_that_are_none_are_refused(
    clip_export: Path, tmp_path: Path, file: str, content: str, message: str
) -> None:
    (clip_export / file).write_text(content)
    with pytest.raises(ModelError, match=message):
        package_of_export(clip_export, tmp_path / "tiny", "someone/tiny", "fp32")
    assert not (tmp_path / "tiny").exists()
