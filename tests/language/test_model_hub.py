"""Pulling models from a hub that fails in many ways."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import ready_made
from hubs import REPOSITORY, Hub, serve
from model_folders import dense_package, graph, succeed, write_manifest

from freeocc3d.cli.main import main
from freeocc3d.core.errors import ModelError
from freeocc3d.language import known_models, model_hub, model_packages


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path / "models"))
    return tmp_path / "models"


@pytest.fixture
def server(tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    folder = dense_package(tmp_path / "remote")
    (folder / "pytorch_model.bin").write_bytes(b"\x80\x04 never fetched")
    with serve(folder) as running:
        monkeypatch.setenv("HF_ENDPOINT", running.url)
        yield running


def test_a_package_is_pulled_whole(server: Hub, home: Path) -> None:
    folder = model_hub.pull_package(REPOSITORY)
    assert folder == home / "tiny"
    model_packages.verify_files(model_packages.read_package(folder))
    assert {path.name for path in folder.iterdir()} == {"manifest.yaml", "image.onnx", "text.onnx", "tokenizer.json"}
    assert {path.name for path in home.iterdir()} == {"tiny"}


def test_what_is_there_is_not_fetched_again(server: Hub) -> None:
    model_hub.pull_package(REPOSITORY)
    before = len(server.requested)
    model_hub.pull_package(REPOSITORY)
    assert len(server.requested) == before


@pytest.mark.parametrize("ranges", [True, False])
def test_an_interrupted_pull_goes_on_where_it_stopped(server: Hub, home: Path, ranges: bool) -> None:
    large = 6_000_000  # numbers; the library hands ten megabytes on at a time
    graph(server.folder / "text.onnx", {"tokens": ["t", "l"]}, {"features": [1, 8], "more": [large]})
    write_manifest(server.folder)
    server.cut["text.onnx"] = 3 * large
    with pytest.raises(ModelError, match=r"answered 503 to the request for someone/tiny"):
        model_hub.pull_package(REPOSITORY)
    assert not (home / "tiny").exists()
    (kept,) = (path.stat().st_size for path in (home / "tiny.partial").glob("*.incomplete"))
    assert 0 < kept <= 3 * large
    server.cut, server.down, server.ranges, server.requested = {}, False, ranges, []
    model_packages.verify_files(model_packages.read_package(model_hub.pull_package(REPOSITORY)))
    assert [asked for asked in server.requested if asked[0] == "text.onnx"] == [("text.onnx", f"bytes={kept}-")]
    assert "image.onnx" not in dict(server.requested)  # it was whole already


def test_content_that_differs_from_its_hash_is_dropped(server: Hub, home: Path) -> None:
    server.spoilt.add("image.onnx")
    with pytest.raises(ModelError, match=r"image\.onnx of someone/tiny does not match the hub's hash"):
        model_hub.pull_package(REPOSITORY)
    assert not (home / "tiny").exists()
    assert not list((home / "tiny.partial").glob("image.onnx*"))
    server.spoilt.clear()
    model_packages.verify_files(model_packages.read_package(model_hub.pull_package(REPOSITORY)))


def test_what_differs_from_the_manifest_is_no_package(server: Hub, home: Path) -> None:
    (server.folder / "text.onnx").write_bytes(b"exchanged on the hub, its own hash too")
    with pytest.raises(ModelError, match=r"text\.onnx is damaged"):
        model_hub.pull_package(REPOSITORY)
    assert not (home / "tiny").exists()


def test_a_manifest_that_lists_what_is_not_there(server: Hub) -> None:
    (server.folder / "text.onnx").unlink()
    with pytest.raises(ModelError, match=r"someone/tiny lacks files of its manifest: text\.onnx"):
        model_hub.pull_package(REPOSITORY)


def test_a_manifest_cannot_reach_out_of_its_folder(server: Hub, home: Path) -> None:
    text = (server.folder / "manifest.yaml").read_text().replace("text.onnx", "../text.onnx")
    (server.folder / "manifest.yaml").write_text(text)
    with pytest.raises(ModelError, match="is not the plain name of a file"):
        model_hub.pull_package(REPOSITORY)


PARTS = ("model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors", "model.safetensors.index.json")


@pytest.mark.parametrize("weights", [("model.safetensors",), PARTS], ids=["one", "parts"])
def test_a_checkpoint_is_pulled_without_what_could_run_code(server: Hub, home: Path, weights: tuple[str, ...]) -> None:
    for name in ("manifest.yaml", "image.onnx", "text.onnx"):
        (server.folder / name).unlink()
    (server.folder / "config.json").write_text("{}")
    for name in weights:
        (server.folder / name).write_bytes(name.encode())
    (server.folder / "modeling.py").write_text("import os")
    folder = model_hub.pull_package(REPOSITORY)
    assert folder == home / ".checkpoints" / "tiny"
    assert {path.name for path in folder.iterdir()} == {"config.json", *weights, "tokenizer.json"}
    assert not model_packages.list_installed()


def test_pickled_weights_are_refused(server: Hub) -> None:
    for path in server.folder.iterdir():
        if path.suffix != ".bin":
            path.unlink()
    with pytest.raises(ModelError, match=r"neither a model package .* nor weights as safetensors"):
        model_hub.pull_package(REPOSITORY)


@pytest.fixture
def words(server: Hub, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Hub:
    """The hub with a tiny CLIP in the layout of the recommended model, and in its place."""
    shutil.rmtree(server.folder)
    ready_made.copy_export(tmp_path_factory, server.folder, "clip", "int8", "sdpa")
    (server.folder / "onnx" / "model_q4.onnx").write_bytes(b"not fetched")
    monkeypatch.setitem(model_hub.NAMES, "clip-b16", REPOSITORY)
    return server


def test_words_are_pulled_as_a_ready_made_export(words: Hub, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    succeed(["models", "pull", "words"])
    assert capsys.readouterr().out.strip() == str(home / "clip-b16")
    package = model_packages.read_package(home / "clip-b16")
    assert (package.kind, package.precision, package.source) == ("clip", "int8", REPOSITORY)
    assert {path.name for path in home.iterdir()} == {"clip-b16"}
    fetched = [name for name, _ in words.requested]
    assert "onnx/vision_model_quantized.onnx" in fetched
    assert "onnx/model_q4.onnx" not in fetched
    model_hub.pull_package("words")
    assert [name for name, _ in words.requested] == fetched


def test_one_of_several_models_of_a_repository_is_pulled(
    words: Hub, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = known_models.KnownModel(REPOSITORY, True, 1, "mit", 24, 1, "int8", "s2")
    monkeypatch.setitem(known_models.KNOWN, "several", known)
    monkeypatch.setitem(known_models.NAMES, "several", REPOSITORY)
    for folder in ("s1", "s2"):
        (words.folder / "onnx" / folder).mkdir()
        (words.folder / "onnx" / folder / "config.json").write_text('{"model_type": "bert"}')
    for path in (words.folder / "config.json", *(words.folder / "onnx").glob("*_quantized.onnx")):
        path.rename(words.folder / "onnx" / "s2" / path.name)
    model_hub.pull_package("several")
    assert model_packages.read_package(home / "several").kind == "clip"
    assert {name for name, _ in words.requested if "onnx/" in name} == {
        "onnx/s2/config.json", "onnx/s2/text_model_quantized.onnx", "onnx/s2/vision_model_quantized.onnx"
    }  # fmt: skip


def test_an_interrupted_export_goes_on_where_it_stopped(words: Hub, home: Path) -> None:
    words.cut["onnx/vision_model_quantized.onnx"] = 9000
    with pytest.raises(ModelError, match="answered 503"):
        model_hub.pull_package("words")
    assert not (home / "clip-b16").exists()
    words.cut, words.down, words.requested = {}, False, []
    model_packages.verify_files(model_packages.read_package(model_hub.pull_package("words")))
    assert dict(words.requested)["onnx/vision_model_quantized.onnx"] == "bytes=9000-"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda hub: (hub.folder / "tokenizer.json").unlink(), "lacks tokenizer.json, which its graphs need"),
        (
            lambda hub: (hub.folder / "onnx" / "text_model_quantized.onnx").unlink(),
            r"is laid out otherwise .* it has onnx/model_q4\.onnx, onnx/vision_model_quantized\.onnx, but not",
        ),
        (
            lambda hub: (hub.folder / "tokenizer.json").write_bytes(b" " * 100_000_000),
            r"tokenizer\.json of someone/tiny has 100,000,000 bytes, more than",
        ),
        (lambda hub: setattr(hub, "gated", True), r"someone/tiny is gated: accept its terms at http.*/someone/tiny"),
        (lambda hub: hub.spoilt.add("onnx/text_model_quantized.onnx"), "does not match the hub's hash"),
    ],
)
def test_exports_that_cannot_be_pulled(words: Hub, home: Path, change: Any, message: str) -> None:
    change(words)
    with pytest.raises(ModelError, match=message):
        model_hub.pull_package("words")
    assert not (home / "clip-b16").exists()


def test_a_full_disk_and_what_is_forbidden_are_told(words: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 9, 1))
        with pytest.raises(ModelError, match=r"needs [\d,]+ bytes while its package is made, but .* has 1 free"):
            model_hub.pull_package("words")
    with pytest.raises(ModelError, match="has no graphs of fp16, only of int8"):
        model_hub.pull_package("words", precision="fp16")
    monkeypatch.setenv("FREEOCC3D_OFFLINE", "1")
    with pytest.raises(ModelError, match="is not fetched, because FREEOCC3D_OFFLINE is set"):
        model_hub.pull_package("words")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("someone/else", "has no readable repository someone/else"),
        ("clip-b16-opena", r"nor a repository OWNER/NAME .* \(did you mean 'clip-b16-openai'\?\)"),
        ("a/b/c", "nor a repository OWNER/NAME"),
        ("a/..", "nor a repository OWNER/NAME"),
        ("../tiny", "nor a repository OWNER/NAME"),
        ("wrds", r"\(did you mean 'words'\?\)"),
    ],
)
def test_names_that_are_none(server: Hub, name: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        model_hub.pull_package(name)


def test_no_network_is_reported_in_a_sentence(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")  # nobody listens there
    with pytest.raises(SystemExit, match="1"):
        main(["models", "pull", REPOSITORY])
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "Cannot fetch someone/tiny from http://127.0.0.1:9" in said
    assert "pull again when the network works" in said


def test_the_command_says_where_it_is(server: Hub, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    succeed(["models", "pull", REPOSITORY])
    assert capsys.readouterr().out.strip() == str(home / "tiny")
    shutil.rmtree(home)
    for name in ("manifest.yaml", "image.onnx", "text.onnx"):
        (server.folder / name).unlink()
    (server.folder / "model.safetensors").write_bytes(b"weights")
    succeed(["models", "pull", REPOSITORY])
    assert "a checkpoint; export it: freeocc3d models export" in " ".join(capsys.readouterr().out.split())
