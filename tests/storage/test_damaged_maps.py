"""Damaged and hostile maps: each is refused with a sentence that names the file, before it is used. Hostile ones state
the right sizes and checksums."""

import json
import os
import shutil
import socket
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import freeocc3d
from freeocc3d.core.checksums import hash_file
from freeocc3d.core.errors import FreeOccError, MapError
from freeocc3d.storage.saved_map import SavedMap

FILES = ("map.yaml", "config.yaml", "report.json", "trajectory.txt", "gaussians.ply", "occupancy.npz", "features.npz")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = {
        "capture": {"stop": 6, "color_focal": 1.0, "synthetic": {"frames": 60, "width": 80, "height": 60}},
        "fitting": {"passes": 1},
    }
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", settings).path


@pytest.fixture
def copy(saved: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved, tmp_path / "map")


def everything(path: Path) -> SavedMap:
    """The map, with every part read."""
    loaded = SavedMap.open(path)
    _ = loaded.settings, loaded.report, loaded.trajectory, loaded.gaussians, loaded.gaussian_features, loaded.occupancy
    _ = list(loaded.keyframes), loaded.text_encoder.contrast_words()
    return loaded


def sign(path: Path, **changes: Any) -> None:
    """Change the manifest, and state the files as they are."""
    content = yaml.safe_load((path / "map.yaml").read_text()) | changes
    if "files" not in changes:
        found = [name for name in content["files"] if (path / name).is_file()]
        content["files"] |= {name: (path / name).stat().st_size for name in found}
        content["checksums"] |= {name: hash_file(path / name) for name in found}
    (path / "map.yaml").write_text(yaml.safe_dump(content))


def test_a_sound_map_is_read_signed_or_not(copy: Path) -> None:
    whole = everything(copy)
    assert set(whole.manifest.checksums or {}) == set(whole.manifest.files)
    sign(copy)
    np.testing.assert_array_equal(everything(copy).occupancy.keys, whole.occupancy.keys)


def test_a_map_without_checksums_is_read(copy: Path) -> None:
    content = yaml.safe_load((copy / "map.yaml").read_text())
    del content["checksums"]
    (copy / "map.yaml").write_text(yaml.safe_dump(content))
    assert everything(copy).manifest.checksums is None


@pytest.mark.parametrize("name", [*FILES, "keyframes/keyframes.json", "keyframes/000000.color.jpg"])
def test_a_flipped_bit_anywhere_is_told(copy: Path, name: str) -> None:
    whole = (copy / name).read_bytes()
    for place in (0, len(whole) // 3, len(whole) - 60, len(whole) - 1):
        (copy / name).write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        if name == "map.yaml" and place == len(whole) - 60:
            continue  # in the mark of the last line, which then is no mark
        with pytest.raises(MapError, match=Path(name).name.replace(".", r"\.")):
            everything(copy)


def bind(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)
    with socket.socket(socket.AF_UNIX) as opened:
        opened.bind(path.name)
    os.chdir(here)


KINDS: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a socket": bind,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a loop": lambda path: path.symlink_to(path.name),
    "a link to outside": lambda path: path.symlink_to("/etc/hostname"),
    "a folder": Path.mkdir,
    "nothing": lambda path: None,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", [*FILES, "keyframes/keyframes.json", "keyframes/000000.depth.png"])
def test_what_is_no_regular_file_is_named(copy: Path, name: str, kind: str) -> None:
    (copy / name).unlink()
    KINDS[kind](copy / name)
    content = yaml.safe_load((copy / "map.yaml").read_text()) if name != "map.yaml" else {}
    if content:  # the size that such a file has
        with_size = {**content["files"], name: 0}
        (copy / "map.yaml").write_text(yaml.safe_dump({**content, "files": with_size}))
    with pytest.raises(MapError, match=Path(name).name.replace(".", r"\.")):
        SavedMap.open(copy)


@pytest.mark.parametrize(
    "files",
    [
        None, [], [None], 3, {"a": None}, {"a": "1"}, {"a": -1}, {"a": 2**63}, {"a": 1.5}, {None: 3}, {"": 0}, {".": 0},
        {"..": 0}, {"../x": 0}, {"/etc/passwd": 1}, {"a\0b": 1}, {"x" * 5000: 1}, {"keyframes/../../x": 1},
        {"keyframes/": 0}, {"a\\b": 1},
    ],
)  # fmt: skip
def test_names_and_sizes_of_files_are_checked(copy: Path, files: Any) -> None:
    content = yaml.safe_load((copy / "map.yaml").read_text())
    merged = {**content["files"], **files} if isinstance(files, dict) else files
    sign(copy, files=merged, checksums=None)
    with pytest.raises(MapError, match=r"map\.yaml is damaged|lacks its file"):
        SavedMap.open(copy)


@pytest.mark.parametrize("name", [*FILES[1:], "keyframes/keyframes.json"])
def test_a_file_that_every_map_has_must_be_listed(copy: Path, name: str) -> None:
    content = yaml.safe_load((copy / "map.yaml").read_text())
    for key in ("files", "checksums"):
        changed = {**content, key: {n: v for n, v in content[key].items() if n != name}}
        (copy / "map.yaml").write_text(yaml.safe_dump(changed))
        with pytest.raises(MapError, match="lacks"):
            everything(copy)


REPORTS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a list": lambda said: [said],
    "a text": lambda said: "x",
    "nothing": lambda said: None,
    **{f"without {key}": lambda said, key=key: {k: v for k, v in said.items() if k != key} for key in (
        "seconds", "frames", "warnings", "peak_memory_bytes", "frame_log")},
    **{f"{key} a list": lambda said, key=key: {**said, key: [said]} for key in (
        "seconds", "frames", "warnings", "peak_memory_bytes", "frame_log", "color_focal", "submaps", "rendering",
        "check")},
    "a negative count": lambda said: {**said, "frames": {"lost": -1}},
    "a huge number": lambda said: {**said, "peak_memory_bytes": 10**400},
    "a focal length of nothing": lambda said: {**said, "color_focal": 0},
    "an infinite measure": lambda said: {
        **said, "check": {"verdict": "good", "measures": {"step": {"value": float("inf"), "unit": "m", "count": 1}}}},
    "no time": lambda said: {**said, "seconds": {"tracking": float("nan")}},
    "a warning of numbers": lambda said: {**said, "warnings": [{"code": 3, "text": 4}]},
    "a submap without ends": lambda said: {**said, "submaps": [{"frames": 3}]},
    "a short log": lambda said: {**said, "frame_log": {**said["frame_log"], "status": []}},
    "a log of infinite times": lambda said: {
        **said, "frame_log": {**said["frame_log"], "timestamp": [float("inf")] * len(said["frame_log"]["status"])}},
}  # fmt: skip


@pytest.mark.parametrize("kind", REPORTS)
def test_another_structure_of_the_report_is_told(copy: Path, kind: str) -> None:
    said = json.loads((copy / "report.json").read_text())
    (copy / "report.json").write_text(json.dumps(REPORTS[kind](said)))
    sign(copy)
    with pytest.raises(MapError, match=r"report\.json is damaged: .*\.$"):
        _ = SavedMap.open(copy).report


TEXTS = ("[" * 50_000, '{"a":' * 2000, "\x00", "{'a': [1", "\ufffe", "a: *b")


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("name", ["report.json", "keyframes/keyframes.json", "config.yaml", "trajectory.txt"])
def test_texts_that_are_no_documents_are_told(copy: Path, name: str, text: str) -> None:
    (copy / name).write_text(text)
    sign(copy)
    with pytest.raises(FreeOccError, match=Path(name).name.replace(".", r"\.")):
        everything(copy)


def arrays_of(path: Path) -> dict[str, Any]:
    with np.load(path) as archive:
        return dict(archive)


def first(values: np.ndarray, value: Any) -> np.ndarray:
    changed = values.copy()
    changed.reshape(-1)[0] = value
    return changed


OCCUPANCY: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "a probability that is no number": lambda a: {"probability": first(a["probability"], np.nan)},
    "a probability above 1": lambda a: {"probability": first(a["probability"], 1.5)},
    "a negative probability": lambda a: {"probability": first(a["probability"].astype(np.float32), -0.1)},
    "a block far away": lambda a: {"keys": first(a["keys"], 1 << 18)},
    "a block farther than int32": lambda a: {"keys": first(a["keys"].astype(np.int64), 1 << 40)},
    "a block twice": lambda a: {"keys": np.concatenate((a["keys"][:1], a["keys"][:-1]))},
    "an unknown state": lambda a: {"state": first(a["state"], 7)},
    "other counts": lambda a: {"state": first(a["state"], 1 - (a["state"].reshape(-1)[0] == 1))},
    "wide counts": lambda a: {"free": a["free"].astype(np.uint32)},
    "records": lambda a: {"keys": a["keys"].view([("i", a["keys"].dtype)])},
    "too few blocks": lambda a: {name: a[name][:-1] for name in ("keys", "probability", "free", "hits", "state")},
    "too few colors": lambda a: {"colors": a["colors"][:-1]},
    "too short codes": lambda a: {"feature_codes": a["feature_codes"][:, :-1]},
    "levels below all": lambda a: {"levels": np.full(len(a["keys"]), 13, np.uint8)},
    "levels without smaller voxels": lambda a: {"levels": np.full(len(a["keys"]), 1, np.uint8)},
    "no keys": lambda a: {"keys": a["keys"][:, :2]},
}  # fmt: skip


@pytest.mark.parametrize("kind", OCCUPANCY)
def test_voxels_that_no_map_has_are_told(copy: Path, kind: str) -> None:
    arrays = arrays_of(copy / "occupancy.npz")
    np.savez(copy / "occupancy.npz", **(arrays | OCCUPANCY[kind](arrays)))
    sign(copy)
    with pytest.raises(MapError, match=r"occupancy\.npz is damaged"):
        _ = SavedMap.open(copy).occupancy


FEATURES: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "a scale of nothing": lambda a: {"codec_scale": first(a["codec_scale"], 0)},
    "a scale that is no number": lambda a: {"codec_scale": first(a["codec_scale"], np.nan)},
    "an infinite offset": lambda a: {"codec_offset": first(a["codec_offset"], np.inf)},
    "a huge direction": lambda a: {"codec_basis": first(a["codec_basis"].astype(np.float64), 1e300)},
    "other bits": lambda a: {"codec_bits": first(a["codec_bits"], 4)},
    "wide codes": lambda a: {"gaussian_codes": a["gaussian_codes"].astype(np.uint16)},
    "codes of other Gaussians": lambda a: {"gaussian_codes": a["gaussian_codes"][1:]},
}


@pytest.mark.parametrize("kind", FEATURES)
def test_codecs_that_cannot_be_are_told(copy: Path, kind: str) -> None:
    arrays = arrays_of(copy / "features.npz")
    np.savez(copy / "features.npz", **(arrays | FEATURES[kind](arrays)))
    sign(copy)
    with pytest.raises(MapError, match=r"features\.npz is damaged"):
        _ = SavedMap.open(copy).gaussian_features


def test_an_array_that_nobody_needs_is_not_unpacked(copy: Path) -> None:
    arrays = arrays_of(copy / "occupancy.npz")
    np.savez_compressed(copy / "occupancy.npz", **arrays, bomb=np.zeros(200 << 20, np.uint8))
    sign(copy)
    tracemalloc.start()
    try:
        assert len(SavedMap.open(copy).occupancy.keys) == len(arrays["keys"])
        assert tracemalloc.get_traced_memory()[1] < 50 << 20
    finally:
        tracemalloc.stop()


def test_an_array_larger_than_the_manifest_counts_is_not_unpacked(copy: Path) -> None:
    arrays = arrays_of(copy / "occupancy.npz")
    larger = {name: np.zeros((100_000, *arrays[name].shape[1:]), arrays[name].dtype) for name in ("keys", "state")}
    np.savez_compressed(copy / "occupancy.npz", **(arrays | larger))
    sign(copy)
    tracemalloc.start()
    try:
        with pytest.raises(MapError, match="no usable array"):
            _ = SavedMap.open(copy).occupancy
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda lines: lines[:-1], "count different frames"),
        (lambda lines: lines[:1], "count different frames"),
        (lambda lines: [*lines[:-1], "1 2 3"], "8 numbers"),
        (lambda lines: [*lines[:-1], "nan 0 0 0 0 0 0 1"], "not finite"),
        (lambda lines: [*lines[:-1], f"0 1e30 {' 0' * 5} 1"], "too far away"),
        (lambda lines: [line.replace(line.split()[0], "123.5") for line in lines], "lacks the pose of a keyframe"),
    ],
)
def test_a_trajectory_that_is_not_the_report_s_is_told(
    copy: Path, change: Callable[[list[str]], list[str]], said: str
) -> None:
    comment, *lines = (copy / "trajectory.txt").read_text().splitlines()
    (copy / "trajectory.txt").write_text("\n".join([comment, *change(lines)]) + "\n")
    sign(copy)
    with pytest.raises(MapError, match=said):
        _ = SavedMap.open(copy).trajectory


def test_gaussians_of_keyframes_that_are_not_there_are_told(copy: Path) -> None:
    sign(copy, keyframes=[])
    with pytest.raises(MapError, match="anchors in keyframes that the map does not have"):
        _ = SavedMap.open(copy).gaussians
