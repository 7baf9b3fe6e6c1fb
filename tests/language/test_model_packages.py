"""Model packages: what is read, and the messages about what is refused."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import yaml
from model_folders import dense_package, graph, succeed, write_manifest

from freeocc3d.cli.main import main
from freeocc3d.core.errors import ModelError
from freeocc3d.language import model_packages


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path / "models"))
    return tmp_path / "models"


def test_a_package_is_read_verified_and_run(tmp_path: Path) -> None:
    package = model_packages.read_package(dense_package(tmp_path / "tiny"))
    model_packages.verify_files(package)
    assert (package.name, package.kind, package.dimension, package.logit_scale) == ("tiny", "dense", 8, 100.0)
    assert package.bytes == sum(path.stat().st_size for path in package.folder.iterdir() if path.stem != "manifest")
    assert package.session("image").run(["features"], {"image": np.zeros((1, 3, 28, 28), np.float32)})[0].shape[-1] == 8


def test_a_manifest_may_be_json(tmp_path: Path) -> None:
    folder = dense_package(tmp_path / "tiny")
    manifest = yaml.safe_load((folder / "manifest.yaml").read_text())
    (folder / "manifest.yaml").unlink()
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert model_packages.read_package(folder).dimension == 8


def test_a_wrong_hash_is_reported(tmp_path: Path) -> None:
    folder = dense_package(tmp_path / "tiny")
    content = bytearray((folder / "text.onnx").read_bytes())
    content[-5] ^= 1
    (folder / "text.onnx").write_bytes(content)
    package = model_packages.read_package(folder)
    for check in (lambda: model_packages.verify_files(package), lambda: package.session("text")):
        with pytest.raises(ModelError, match=r"text\.onnx is damaged: its sha256 is .*…, but the manifest states"):
            check()
    package.session("image")


def test_what_is_not_onnx_is_reported(tmp_path: Path) -> None:
    folder = dense_package(tmp_path / "tiny")
    (folder / "image.onnx").write_bytes(b"\x80\x04a pickle, perhaps")
    write_manifest(folder)
    with pytest.raises(ModelError, match=r"image\.onnx is not an ONNX network"):
        model_packages.read_package(folder).session("image")


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        (
            {"pixels": [1, 3, 8, 8]},
            {"features": [1, 2, 2, 8]},
            r"takes pixels and gives features, but the image network",
        ),
        (
            {"image": [1, 3, 8, 8]},
            {"logits": [1, 2]},
            r"takes image and gives logits, but the image network of a 'dense'",
        ),
        (
            {"image": [1, 3, 8, 8], "size": [2]},
            {"features": [1, 2, 2, 8]},
            r"takes image, size and gives features",
        ),
        (
            {"image": [1, 3, 8, 8]},
            {"features": [1, 2, 2, 16]},
            r"gives features of 16 dimensions, but the manifest states 8: export the image and text networks from one",
        ),
    ],
)
def test_other_inputs_and_outputs_are_reported(tmp_path: Path, inputs: Any, outputs: Any, message: str) -> None:
    folder = dense_package(tmp_path / "tiny")
    graph(folder / "image.onnx", inputs, outputs)
    write_manifest(folder)
    with pytest.raises(ModelError, match=message):
        model_packages.read_package(folder).session("image")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": 2}, "it must contain format: 1"),
        ({"kind": "diffusion"}, "kind 'diffusion' is not one of clip"),
        ({"dimension": "8"}, "'dimension' has text instead of a whole number"),
        ({"dimension": True}, "'dimension' has true or false instead of a whole number"),
        ({"dimension": 0}, "'dimension' has a number that is not >= 1"),
        ({"dimension": 1 << 40}, "'dimension' has a number that is not <= 65536"),
        ({"patch": 300}, "'input_size' must not be less than 'patch'"),
        ({"mean": [0.5]}, "'mean' has 1 entries instead of 3"),
        ({"std": [0.5, 0.5, 0.0]}, "'std' at least 0.001"),
        ({"std": [0.5, 0.5, float("nan")]}, "must be finite"),
        ({"licence": None}, "'licence' has nothing instead of text"),
        ({"parts": {"image": "image.onnx"}}, "'parts' lacks text, tokenizer"),
        ({"logit_scale": float("inf")}, "'logit_scale' has a number that is not"),
        ({"mean": [1e300, 0, 0]}, "must be at most 1000, and 'std' at least"),
        ({"prefix_tokens": -1}, "'prefix_tokens' has a number that is not >= 0"),
        ({"name": ""}, "'name'"),
        ({"parts": []}, "'parts' has a list instead of a group of keys"),
        ({"files": {"image.onnx": 5}}, "has a whole number instead of text"),
        ({"format": True}, "it must contain format: 1"),
        ({"files": {}}, "'parts' and 'files' must name the same files"),
    ],
)
def test_unusable_manifests_are_reported(tmp_path: Path, changes: Any, message: str) -> None:
    folder = dense_package(tmp_path / "tiny", **changes)
    with pytest.raises(ModelError, match=message) as caught:
        model_packages.read_package(folder)
    assert "manifest.yaml" in str(caught.value)


@pytest.mark.parametrize("name", ["../text.onnx", "/etc/passwd.json", "a/b.onnx", ".hidden.json", "..\\x.onnx"])
def test_no_file_lies_outside_of_its_folder(tmp_path: Path, name: str) -> None:
    parts = {"image": "image.onnx", "text": name, "tokenizer": "tokenizer.json"}
    folder = dense_package(tmp_path / "tiny", parts=parts, files=dict.fromkeys(parts.values(), "0" * 64))
    with pytest.raises(ModelError, match="is not the plain name of a file in its folder"):
        model_packages.read_package(folder)


@pytest.mark.parametrize("name", ["text.pt", "text.bin", "text.pkl", "text"])
def test_other_formats_are_no_part_of_a_package(tmp_path: Path, name: str) -> None:
    parts = {"image": "image.onnx", "text": name, "tokenizer": "tokenizer.json"}
    folder = dense_package(tmp_path / "tiny", parts=parts, files=dict.fromkeys(parts.values(), "0" * 64))
    with pytest.raises(ModelError, match=r"does not end with \.onnx, \.safetensors"):
        model_packages.read_package(folder)


def test_manifests_run_nothing(tmp_path: Path) -> None:
    folder = dense_package(tmp_path / "tiny")
    (folder / "manifest.yaml").write_text("!!python/object/apply:os.system ['true']\n")
    with pytest.raises(ModelError, match=r"Cannot read .*manifest\.yaml"):
        model_packages.read_package(folder)
    (folder / "manifest.yaml").write_text("a: " + "x" * (1 << 20))
    with pytest.raises(ModelError, match="more than the 1 MB"):
        model_packages.read_package(folder)


def test_what_is_lacking_is_reported(tmp_path: Path, home: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ModelError, match="has no manifest"):
        model_packages.read_package(tmp_path / "empty")
    folder = dense_package(tmp_path / "tiny")
    (folder / "text.onnx").unlink()
    with pytest.raises(ModelError, match=r"lacks its file text\.onnx"):
        model_packages.read_package(folder)


def test_packages_are_found_by_folder_and_by_name(tmp_path: Path, home: Path) -> None:
    with pytest.raises(ModelError, match="neither as a folder nor by name"):
        model_packages.find_model("tiny", ("dense",), "language.dinov2.model")
    dense_package(home / "tiny")
    assert model_packages.find_model("tiny", ("dense",), "x").folder == home / "tiny"
    assert model_packages.find_model(str(home / "tiny"), ("dense",), "x").name == "tiny"
    with pytest.raises(ModelError, match=r"There is no model 'tinny' \(did you mean 'tiny'\?\)"):
        model_packages.find_model("tinny", ("dense",), "x")
    with pytest.raises(ModelError, match=r"language\.clip\.model needs a model of kind clip, but .* is of kind dense"):
        model_packages.find_model("tiny", ("clip",), "language.clip.model")
    (tmp_path / "beside").mkdir()
    with pytest.raises(ModelError, match=r"There is no model '\.\./beside'"):
        model_packages.find_model("../beside", ("dense",), "x")


def test_the_command_lists_and_verifies(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    succeed(["models", "list"])
    assert "There are no models" in capsys.readouterr().out
    dense_package(home / "good")
    shutil.copytree(home / "good", home / "bad")
    (home / "bad" / "text.onnx").write_bytes(b"")
    (home / "strange").mkdir()
    succeed(["models", "list", "--json"])
    listed = json.loads(capsys.readouterr().out)["models"]
    assert listed["good"]["dimension"] == 8
    assert "has no manifest" in listed["strange"]["error"]
    succeed(["models", "list"])
    assert "unusable" in capsys.readouterr().out
    succeed(["models", "verify", "good"])
    assert "3 files match their hashes" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="1"):
        main(["models", "verify", "bad"])
    assert "text.onnx is damaged" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="1"):
        main(["models", "verify"])  # one that is damaged hides no other
    said = capsys.readouterr()
    assert "good: 3 files match their hashes" in said.out
    assert "text.onnx is damaged" in said.err
    assert "strange is not a model package" in said.err


@pytest.mark.parametrize("location", ["../weights.onnx.data", "/etc/passwd", "", "a/b.onnx.data", "other.onnx.data"])
def test_weights_elsewhere_are_refused(tmp_path: Path, location: str) -> None:
    folder = dense_package(tmp_path / "tiny")
    (folder / "other.onnx.data").write_bytes(bytes(4 * 8))
    keep_outside(folder / "text.onnx", location)
    write_manifest(folder)
    with pytest.raises(ModelError, match="keeps weights in"):
        model_packages.read_package(folder).session("text")


def test_weights_beside_a_network_are_checked(tmp_path: Path) -> None:
    folder = dense_package(tmp_path / "tiny")
    weights = folder / "text.onnx.data"
    weights.write_bytes(np.arange(8, dtype=np.float32).tobytes())
    keep_outside(folder / "text.onnx", weights.name)
    parts = {"image": "image.onnx", "text": "text.onnx", "tokenizer": "tokenizer.json"}
    files = {name: model_packages.hash_file(folder / name) for name in (*parts.values(), weights.name)}
    write_manifest(folder, files=files)
    package = model_packages.read_package(folder)
    model_packages.verify_files(package)
    (found,) = package.session("text").run(["features"], {"tokens": np.zeros((1, 1), np.float32)})
    assert found.tolist() == [list(range(8))]
    weights.write_bytes(bytes(32))
    with pytest.raises(ModelError, match=r"text\.onnx\.data is damaged"):
        package.session("text")
    with pytest.raises(ModelError, match=r"text\.onnx\.data is damaged"):
        model_packages.verify_files(package)


def keep_outside(path: Path, location: str) -> None:
    """Move the numbers of a network into another file, as it states."""
    model = onnx.load(path)
    (tensor,) = model.graph.initializer
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    path.write_bytes(model.SerializeToString())


@pytest.mark.parametrize("name", ["manifest.yaml", "text.onnx", "tokenizer.json"])
@pytest.mark.parametrize("kind", ["fifo", "folder", "loop", "device"])
def test_only_regular_files_are_read(tmp_path: Path, name: str, kind: str) -> None:
    folder = dense_package(tmp_path / "tiny")
    path = folder / name
    path.unlink()
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to({"loop": path, "device": "/dev/zero"}[kind])
    with pytest.raises(ModelError, match=r"lacks its file|Cannot read|has no manifest"):
        model_packages.verify_files(model_packages.read_package(folder))


def test_a_package_may_consist_of_links_as_in_a_cache_of_downloads(tmp_path: Path) -> None:
    folder = dense_package(tmp_path / "stored")
    (tmp_path / "linked").mkdir()
    for path in folder.iterdir():
        (tmp_path / "linked" / path.name).symlink_to(path)
    package = model_packages.read_package(tmp_path / "linked")
    model_packages.verify_files(package)
    assert package.session("image").outputs
    (folder / "image.onnx").write_bytes((folder / "text.onnx").read_bytes())
    with pytest.raises(ModelError, match=r"image\.onnx is damaged"):
        package.session("image")
