"""Damaged and hostile maps, in every command that reads one, and in Python. Half of them state the right checksums."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import random
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

import freeocc3d
from freeocc3d.core.checksums import hash_bytes, hash_file
from freeocc3d.editing.adaptive_voxels import refine_where_needed
from freeocc3d.evaluation.ground_truth import save_ground_truth
from freeocc3d.evaluation.true_occupancy import GroundTruth
from freeocc3d.export import export_map
from freeocc3d.settings import registry

from . import mutators
from .harness import Attack, Silent, command

SHORT = 40

_SETTINGS: dict[str, Any] = {
    "capture": {"stop": 8, "color_focal": 1, "synthetic": {"frames": 60, "width": 80, "height": 60}},
    "occupancy": {"voxel_size": 0.1},
    "fitting": {"passes": 1},
}
_SEAL = b"\n# xxh3_128 "
_NAMES = ("config.yaml", "report.json", "trajectory.txt", "gaussians.ply", "occupancy.npz", "features.npz")


def prepare(folder: Path) -> None:
    """Four maps, each named ``map`` in a folder of its own: colors, classes, several voxel sizes, unknown scale."""
    freeocc3d.reconstruct("builtin:room", folder / "color" / "map", _SETTINGS)
    freeocc3d.reconstruct("builtin:room", folder / "labels" / "map", {**_SETTINGS, "language": {"encoder": "labels"}})
    refine_where_needed(freeocc3d.load_map(folder / "color" / "map"), 0.05, _parent(folder / "refined" / "map"))
    shutil.copytree(folder / "color" / "map", folder / "unscaled" / "map")
    _edit_manifest(folder / "unscaled" / "map", scale={"metric": False, "by": "none", "factor": 1.0})
    freeocc3d.load_map(folder / "unscaled" / "map")
    _prepare_scoring(folder / "color" / "map", _parent(folder / "scoring" / "x").parent)


def _prepare_scoring(path: Path, folder: Path) -> None:
    """A truth, true poses, and the results of other systems."""
    loaded = freeocc3d.load_map(path)
    labels = np.zeros((40, 40, 30), np.uint8)
    labels[:, :3], labels[:3], labels[30:] = 1, 2, 255
    truth = GroundTruth(labels, np.array([-2.0, -2.0, -1.5]), 0.1, ("free", "wall", "sofa"), None)
    save_ground_truth(truth, folder / "truth.npz")
    export_map(loaded, "gaussians", folder / "splat.ply", {})
    export_map(loaded, "npz", folder / "grid.npz", {})
    shutil.copy(path / "trajectory.txt", folder / "poses.txt")
    g = loaded.gaussians[:200]
    arrays = {name: getattr(g, name) for name in ("means", "scales", "quats_wxyz", "opacities")}
    (folder / "frames").mkdir()
    time = (path / "trajectory.txt").read_text().splitlines()[1].split()[0]
    np.savez(folder / "frames" / f"frame_{time}.npz", **arrays, labels=np.ones(200, np.int64))


def _attack_scoring(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """A damaged truth, trajectory, or result of another system."""
    shutil.copytree(originals / "scoring", folder, dirs_exist_ok=True)
    shutil.copytree(originals / "color" / "map", folder / "map")
    frame = next((folder / "frames").glob("*.npz")).relative_to(folder)
    name, run = rng.choice((
        ("splat.ply", "--gaussians splat.ply --align none"), ("grid.npz", "--grid grid.npz --align none"),
        (str(frame), "--frames frames --poses poses.txt"), ("truth.npz", "map --poses poses.txt"),
        ("truth.npz", "--grid grid.npz --align none"), ("poses.txt", "map --poses poses.txt"),
        ("poses.txt", "--gaussians splat.ply --trajectory poses.txt --poses poses.txt"),
    ))  # fmt: skip
    changes: dict[str, tuple[Change, ...]] = {
        ".txt": (mutators.change_lines,),
        ".ply": (_change_ply_header, _change_ply_values, _change_ply_values),
        ".npz": (_change_array, _change_array, _change_archive),
    }
    change = rng.choice((*changes[Path(name).suffix], mutators.change_bytes, mutators.change_kind))
    try:
        done = change(rng, folder / name)
    except Exception as error:
        done = type(error).__name__
    line = f"evaluate {run} --ground-truth truth.npz --json"
    return Attack(f"{line}; {name}: {done}", functools.partial(_printed, *line.split(" ")))


def attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """One damaged map, and one use of it; or what maps are scored with."""
    if rng.random() < 0.12:
        return _attack_scoring(rng, originals, folder)
    kind = rng.choice(("color", "color", "labels", "refined", "unscaled"))
    shutil.copytree(originals / kind / "map", folder / "map")
    signed = rng.random() < 0.55
    done = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        name, change = _choose(rng, folder / "map")
        if not (folder / "map" / name).is_file() and change is not mutators.change_kind:
            continue  # an earlier change replaced it
        try:
            done.append(f"{name}: {change(rng, folder / 'map' / name)}")
        except Exception as error:  # an earlier change left nothing of the kind
            done.append(f"{name}: ({type(error).__name__})")
    if signed:
        _sign(folder / "map", rng)
    manifest = folder / "map" / "map.yaml"
    changed = signed or not manifest.is_file() or manifest.is_symlink() or _SEAL not in manifest.read_bytes()
    use, run = _USES[rng.choices(range(len(_USES)), [weight for weight, *_ in _USES])[0]][1:]
    description = f"{use} of {kind}{' signed' if signed else ''}; {'; '.join(done)}"
    return Attack(description, functools.partial(_run, run, originals / kind, folder, changed))


def _run(run: Callable[[], str], original: Path, folder: Path, changed: bool) -> None:
    """Use the damaged map. Unless it was changed on purpose, that is, states other checksums or none of the manifest,
    the answer must be that of the sound map."""
    answer = run()
    if not changed and answer:
        for made in ("out", "out.npz"):
            (folder / made).unlink(missing_ok=True)
        if answer != _sound_answer(run, original):
            raise Silent("the answer is not that of the sound map")


@functools.cache
def _sound_answer(run: Callable[[], str], original: Path) -> str:
    here = Path.cwd()
    os.chdir(original)
    try:
        return run()
    finally:
        os.chdir(here)


def _parent(path: Path) -> Path:
    path.parent.mkdir()
    return path


def _edit_manifest(path: Path, **changes: Any) -> None:
    content = yaml.safe_load((path / "map.yaml").read_text(encoding="utf-8"))
    data = yaml.safe_dump({**content, **changes}, sort_keys=False).encode().rstrip(b"\n")
    (path / "map.yaml").write_bytes(data + _SEAL + hash_bytes(data).encode() + b"\n")


def _sign(path: Path, rng: random.Random) -> None:
    """State the sizes and checksums of the files as they are now, and the manifest's own."""
    manifest = path / "map.yaml"
    if not manifest.is_file() or manifest.is_symlink():
        return
    data = manifest.read_bytes().rpartition(_SEAL)[0] or manifest.read_bytes()
    with contextlib.suppress(Exception):
        content: Any = None if b"*l" in data or len(data) > 1 << 18 else yaml.safe_load(data)
        if rng.random() < 0.5:
            _recount(path, content["counts"])
        for name in list(content["files"]):
            found = path / name
            if found.is_file():
                content["files"][name] = found.stat().st_size
                content["checksums"][name] = hash_file(found)
            elif found.exists():
                content["files"][name] = 0
        data = yaml.safe_dump(content, sort_keys=False).encode().rstrip(b"\n")
    if rng.random() < 0.2:
        manifest.write_bytes(data)
    else:
        manifest.write_bytes(data + _SEAL + hash_bytes(data).encode() + b"\n")


def _recount(path: Path, counts: Any) -> None:
    """State the numbers of voxels and Gaussians as they are now."""
    if not all((path / name).is_file() for name in ("occupancy.npz", "gaussians.ply")):
        return
    with contextlib.suppress(Exception), np.load(path / "occupancy.npz") as archive:
        state = archive["state"]
        for name, value in (("occupied", 1), ("free", 0), ("unknown", 255)):
            counts["voxels"][name] = int(np.count_nonzero(state == value))
    if found := re.search(rb"element vertex (\d+)", (path / "gaussians.ply").read_bytes()[:500]):
        counts["gaussians"] = int(found[1])


Change = Callable[[random.Random, Path], str]


def _choose(rng: random.Random, path: Path) -> tuple[str, Change]:
    """A file of the map, and a way to damage it."""
    if rng.random() < 0.12:
        return rng.choice(("map.yaml", "keyframes", _image(rng, path), *_NAMES)), mutators.change_kind
    name = rng.choices(
        ("map.yaml", "report.json", "config.yaml", "trajectory.txt", "keyframes/keyframes.json", "gaussians.ply",
         "occupancy.npz", "features.npz", "image"),
        (8, 4, 2, 2, 3, 5, 6, 4, 3),
    )[0]  # fmt: skip
    if name == "image":
        return _image(rng, path), rng.choice((mutators.change_bytes, _change_image, _change_image_header))
    if name == "features.npz" and (path / "objects.npz").exists() and rng.random() < 0.6:
        name = "objects.npz"
    if rng.random() < 0.15:
        return rng.choice((("map.yaml", _stretch_manifest), ("keyframes/keyframes.json", _stretch_cameras)))
    changes: dict[str, tuple[Change, ...]] = {
        ".yaml": (mutators.change_yaml, mutators.change_yaml, mutators.change_lines),
        ".json": (mutators.change_json, mutators.change_json, mutators.change_lines),
        ".txt": (mutators.change_lines, mutators.change_lines),
        ".ply": (_change_ply_header, _change_ply_header, _change_ply_values, _change_ply_values),
        ".npz": (_change_array, _change_array, _change_array, _change_archive),
    }
    return name, rng.choice((*changes[Path(name).suffix], mutators.change_bytes))


def _stretch_manifest(rng: random.Random, path: Path) -> str:
    """Numbers that a map may have, but hardly ever has."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    size = rng.choice((1e-6, 1e-4, 0.3, 50.0, 1e4, 1e6))
    smallest = {"finest_voxel_m": size / 2} if "finest_voxel_m" in content else {}
    far = [rng.choice((0.0, -1e9, 1e5, 1e9)) for _ in range(3)]
    turned = np.eye(4)[rng.choice(([0, 1, 2, 3], [1, 2, 0, 3], [2, 0, 1, 3]))]
    turned[:3, 3] = far
    change: dict[str, Any] = rng.choice((
        {"voxel_size_m": size, **smallest}, {"origin": far},
        {"T_gravity_map": turned.tolist()}, {"T_gravity_map": None},
        {"up": rng.choice(([1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.0, -0.8]))}, {"T_world_map": turned.tolist()},
        {"scale": {"metric": rng.random() < 0.5, "by": "poses", "factor": rng.choice((1e-9, 1e9))}},
        {"encoder": {"name": rng.choice(("labels", "segmenter", "clip", "color.x")), "state": {"classes": ["", "a"]}}},
        {"encoder": {"name": "labels", "dimension": 0, "state": {"classes": [f"c{n}" for n in range(12)]}}},
        {"vocabulary": {"model": "m", "keyframes": [0], "names": {"red": {"count": 1}, "\u202e": {"count": 9}}}},
        {"capture": {"path": rng.choice(("/", "/dev/zero", "x" * 5000, "", "builtin:none")), "format": "x"}},
    ))  # fmt: skip
    path.write_text(yaml.safe_dump({**content, **change}, sort_keys=False), encoding="utf-8")
    return f"{change!r:.120}"


def _stretch_cameras(rng: random.Random, path: Path) -> str:
    """Cameras that may be, but hardly ever are."""
    entries = json.loads(path.read_text(encoding="utf-8"))
    key = rng.choice(("fx", "fy", "cx", "cy", "timestamp"))
    value = rng.choice((1e-3, 1.0, 1e5, 1e9))
    for entry in entries if rng.random() < 0.5 else entries[:1]:
        entry[key] = value
    path.write_text(json.dumps(entries), encoding="utf-8")
    return f"{key} = {value}"


def _image(rng: random.Random, path: Path) -> str:
    images = sorted((path / "keyframes").glob("*.[jp]*g"))
    return f"keyframes/{rng.choice(images).name}" if images else "map.yaml"


def _change_image(rng: random.Random, path: Path) -> str:
    """Another image in the place of a keyframe's."""
    shape = rng.choice(((60, 80), (60, 80, 3), (60, 80, 4), (80, 60), (1, 1), (6000, 8000), (61, 80, 3)))
    values = np.full(shape, rng.choice((0, 1, 255)), rng.choice((np.uint8, np.uint16)))
    form = rng.choice((".png", ".jpg", ".tiff", ".webp", ".bmp"))
    try:
        path.write_bytes(cv2.imencode(form, values)[1].tobytes())
    except cv2.error:
        path.write_bytes(cv2.imencode(".png", values)[1].tobytes())
    return f"{form} {shape} {values.dtype}"


def _change_image_header(rng: random.Random, path: Path) -> str:
    """A header that states another, perhaps a huge, size."""
    data = bytearray(path.read_bytes())
    width, height = rng.choice(((80, 60), (100_000, 100_000), (65_535, 65_535), (80, 30_000), (0, 60), (1 << 31, 1)))
    if path.suffix == ".png":
        depth, color = rng.choice((1, 8, 16)), rng.choice((0, 2, 3, 6))
        header = b"IHDR" + struct.pack(">II5B", width, height, depth, color, 0, 0, rng.choice((0, 0, 1)))
        data[12:33] = header + struct.pack(">I", zlib.crc32(header))
        return f"a header of {width} x {height}, {depth} bits, type {color}"
    at = next((place for place in range(len(data)) if data[place : place + 2] in (b"\xff\xc0", b"\xff\xc2")), 2)
    data[at + 5 : at + 9] = struct.pack(">HH", height & 65_535, width & 65_535)
    path.write_bytes(data)
    return f"a header of {width & 65_535} x {height & 65_535}"


def _change_ply_header(rng: random.Random, path: Path) -> str:
    data = path.read_bytes()
    text, end, body = data.partition(b"end_header\n")
    lines = text.decode("latin-1").splitlines()
    row = rng.randrange(1, len(lines))
    action = rng.randrange(7)
    if action == 0:
        lines = [
            re.sub(r"vertex \d+", f"vertex {rng.choice((0, 1, -1, 2**31, 2_000_000_000, 10**30))}", line)
            for line in lines
        ]
    elif action == 1:
        kind = rng.choice(("double", "char", "uchar", "int", "float", "short", "float128", "list uchar int"))
        words = lines[row].split()
        lines[row] = f"property {kind} {words[-1]}"
    elif action == 2:
        del lines[row]
    elif action == 3:
        lines.insert(
            row, rng.choice((lines[row], "element face 3", "property list uchar int i", "comment", "obj_info x"))
        )
    elif action == 4:
        lines[1] = f"format {rng.choice(('ascii', 'binary_big_endian', 'binary', ''))} 1.0"
    elif action == 5:
        lines[row] = f"{lines[row]} {'x' * rng.choice((1, 5000, 70_000))}"
    else:
        lines[row] = rng.choice(("property", "element", "format", "\xff", "element vertex", "element vertex 1e5"))
    path.write_bytes("\n".join(lines).encode("latin-1") + b"\n" + end + body)
    return f"header, kind {action}, {lines[min(row, len(lines) - 1)]!r:.60}"


def _change_ply_values(rng: random.Random, path: Path) -> str:
    """Numbers that no Gaussian has, in one property or everywhere."""
    data = path.read_bytes()
    text, end, body = data.partition(b"end_header\n")
    words = [line.split() for line in text.decode("latin-1").splitlines()]
    names = {"float": "<f4", "int": "<i4", "uchar": "u1"}
    kinds = [(line[2], names[line[1]]) for line in words if line[0] == "property"]
    rows = np.frombuffer(body, np.dtype(kinds)).copy()
    name = rng.choice(rows.dtype.names or ("x",))
    value = rng.choice((0, -1, 1, 2, 300, np.nan, np.inf, 1e38, 1e-30, 1e7, 2**30, -(2**31)))
    at = slice(None) if rng.random() < 0.5 else slice(0, rng.choice((1, len(rows) // 2)))
    with np.errstate(all="ignore"):
        rows[name][at] = np.array(value).astype(rows.dtype[name])
    path.write_bytes(text + end + rows.tobytes())
    return f"{name} = {value} in {at}"


def _change_array(rng: random.Random, path: Path) -> str:
    """One array of an archive with other values, another type or shape; without it, or with others."""
    with np.load(path) as archive:
        arrays: dict[str, Any] = dict(archive)
    name = rng.choice(list(arrays))
    values, action = arrays[name], rng.randrange(9)
    with np.errstate(all="ignore"):
        if action == 0:
            del arrays[name]
        elif action == 1:
            kind = rng.choice(
                ("f2", "f4", "f8", "i1", "i4", "i8", "u1", "u2", "u4", "u8", "?", "U3", "c8", ">i4", ">f4")
            )
            arrays[name] = values.astype(kind)
        elif action == 2:
            cut = (values[:-1], values[:, :-1] if values.ndim > 1 else values[:0], values[None], values.ravel())
            arrays[name] = rng.choice((*cut, np.concatenate((values, values)), np.asfortranarray(values)))
        elif action in (3, 4, 5) and values.size:
            extreme = rng.choice(
                (0, 1, -1, 2, 3, 7, 12, 13, 31, 254, 255, 1e5, 2**17, 2**20, 2**31 - 1, -(2**31), np.nan, np.inf)
            )
            changed = values.copy()
            count = rng.choice((1, max(values.size // 2, 1), values.size))
            changed.reshape(-1)[rng.randrange(values.size) if count == 1 else slice(0, count)] = np.array(
                extreme
            ).astype(values.dtype)
            arrays[name] = changed
            name = f"{name} = {extreme} x {count}"
        elif action == 6:
            arrays["bomb"] = np.zeros(rng.choice((1 << 10, 300 << 20)), np.uint8)
        elif action == 7:
            arrays[name] = np.zeros(rng.choice(((0,) * values.ndim, (1 << 27,), (1 << 15, 512))), values.dtype)
        else:
            order = np.random.default_rng(rng.randrange(1 << 30)).permutation(len(values))
            arrays[name] = values[order]
    np.savez_compressed(path, **arrays)
    return f"array {name}, kind {action}"


def _change_archive(rng: random.Random, path: Path) -> str:
    """Tricks with the archive itself."""
    with zipfile.ZipFile(path) as archive:
        content = {info.filename: archive.read(info) for info in archive.infolist()}
    name, action = rng.choice(list(content)), rng.randrange(7)
    kind = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    if action == 0:
        kind = rng.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    elif action == 1:
        length = rng.choice((b"(1073741824,)", b"(-1,)", b"(9999999999, 9999999999)", b"((((1", b"(True,)", b"(1.5,)"))
        content[name] = re.sub(rb"\([\d, ]*\)", length, content[name], count=1)
    elif action == 2:
        content[name] = re.sub(rb"'descr': '[^']*'", b"'descr': [('a', '<i4'), ('b', '|O')]", content[name], count=1)
    elif action == 3:
        content[rng.choice(("../x.npy", "/x.npy", "x", "", "keys.npy/", "a\0b.npy"))] = content[name]
    elif action == 4:
        content[name] = content[name][: rng.choice((0, 5, 10, 60, len(content[name]) // 2))]
    with zipfile.ZipFile(path, "w", kind) as archive:
        for inner, data in content.items():
            archive.writestr(inner, data)
        if action == 5:
            archive.writestr(zipfile.ZipInfo("twice.npy"), content[name])
            archive.filelist[-1].filename = archive.filelist[-1].orig_filename = name
    if action == 6:
        packed = bytearray(path.read_bytes())
        for start, offset in (
            (b"PK\x03\x04", rng.choice((6, 8, 14, 22))),
            (b"PK\x01\x02", rng.choice((8, 10, 16, 24, 42))),
        ):
            packed[packed.index(start) + offset] ^= rng.choice((1, 8, 255))
        path.write_bytes(packed)
    return f"archive, kind {action}, {name}"


def _printed(*arguments: object) -> str:
    """What a command prints."""
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            command(*arguments)
    except SystemExit as error:
        if error.code:
            raise
    return out.getvalue()


def _exported(name: str, frame: str) -> str:
    _printed("export", "map", "--format", name, "-o", "out", "--frame", frame, "--overwrite")
    return ""


def _everything() -> str:
    """All that Python offers of a map."""
    loaded = freeocc3d.load_map("map")
    said: list[Any] = [loaded.gaussians, loaded.occupancy, loaded.trajectory]
    numbers = [
        hash_bytes(np.asarray(getattr(part, name)).tobytes()) for part in said for name in part.__dataclass_fields__
    ]
    numbers += [hash_bytes(loaded.gaussian_features.tobytes())]
    numbers += [hash_bytes(frame.color.tobytes() + frame.depth_m.tobytes()) for frame in loaded.keyframes]
    result = loaded.query("red")
    loaded.labels()
    loaded.views_of_each(result.regions)
    loaded.stands_of(result.regions)
    loaded.boxes_of(result.regions)
    return json.dumps(
        [*numbers, loaded.vocabulary, loaded.scene_words, loaded.up.tolist(), loaded.T_gravity_map.tolist()]
    )


def _uses() -> list[tuple[float, str, Callable[[], str]]]:
    """Weight, name, and a function that uses the map ``map`` in the present folder and returns the answer."""
    commands: list[tuple[float, str]] = [
        (3, "info map"), (3, "info map --json"), (2, "check map --json"), (4, "query map red wall --json"),
        (1, "query map --classes"),
        (3, "query map chair red --json --views"), (0.1, "query map red --html out --overwrite"),
        (1, "query map --class red --class wall --json"), (1, "query map red --near wall --json"),
        (0.5, "query map wall --on floor --pick largest --ply out --overwrite"),
        (1, "scale map -o out --factor 2 --overwrite"),
        (1, "scale map -o out --length 0:20,20 0:60,40 1.5 --overwrite"),
        (1, "scale map -o out --camera-height 1.4 --overwrite"),
        (0.3, "scale map -o out --poses builtin:room --overwrite"), (0.4, "refine map --voxel 0.05 -o out --overwrite"),
        (0.1, "view map --picture out --overwrite"),
    ]  # fmt: skip
    compared = ("info", "query map red wall", "query map chair", "query map --class")
    uses: list[tuple[float, str, Callable[[], str]]] = []
    for weight, line in commands:
        run = functools.partial(_printed, *line.split(" "))
        uses.append((weight, line, run if line.startswith(compared) else functools.partial(_quiet, run)))
    for name in registry.backends("export"):
        uses.append((0.6, f"export {name}", functools.partial(_exported, name, "map")))
    uses.append((0.4, "export npz, first camera", functools.partial(_exported, "npz", "first-camera")))
    return [*uses, (5, "everything", _everything)]


def _quiet(run: Callable[[], str]) -> str:
    run()
    return ""


_USES = _uses()
