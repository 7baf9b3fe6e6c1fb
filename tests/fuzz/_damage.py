"""Damages one file: as bytes, as text, as a document, as an image, or by what stands in its place."""

from __future__ import annotations

import json
import os
import random
import re
import socket
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

EXTREMES: tuple[Any, ...] = (
    None, True, [], {}, "", "x", "\0", "\ud800", "NaN", 0, -1, 1e-300, 1e308, -1e308, float("nan"), float("inf"),
    2**31, 2**63, 2**64, 10**400, 10**5000, "../../etc/passwd", "/dev/zero", ".", "a" * 5000, "é" * 300, "1" * 5000,
    "2020-99-99", [[[]]], {"a": {"b": {}}}, [None] * 50, "images/",
)  # fmt: skip
WORDS = (
    "nan", "inf", "-inf", "1e308", "-1e999", "0", "-1", "x", "", "1e-320", "9" * 400, "9" * 5000, "0x10", "1_0", "١٢",
    "1,5", "null", "\0", "4294967296", "18446744073709551615", "1e12", "#",
)  # fmt: skip
NUMBERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)


TEXTS = (".json", ".txt", ".yaml", ".log", ".xyz", ".csv", ".traj", ".pincam")


def damage(rng: random.Random, path: Path) -> str:
    """Damage the file in a way that suits its kind, and return what was done."""
    kinds: list[Callable[[random.Random, Path], str]] = [damage_bytes, damage_bytes, replace]
    suffix = path.suffix.lower()
    if (suffix in TEXTS or path.name == "metadata") and path.is_file():
        kinds += [damage_text] * 4
    if suffix == ".json" or path.name == "metadata":
        kinds += [damage_document] * 8
    if suffix in (".png", ".jpg", ".tif", ".webp", ".bmp"):
        kinds += [damage_image] * 4
    return f"{path.name}: {rng.choice(kinds)(rng, path)}"


def damage_bytes(rng: random.Random, path: Path) -> str:
    """Truncation, flipped bits, spliced, repeated or missing parts, zeros, extreme numbers, other content."""
    data = bytearray(path.read_bytes())
    kind = rng.choice(
        ("cut", "bits", "bytes", "drop", "repeat", "zeros", "number", "number", "append", "other", "swap")
    )
    size = len(data)
    a, b = sorted((rng.randrange(size + 1), rng.randrange(size + 1)))
    if kind == "cut":
        del data[a:]
    elif kind == "bits":
        for _ in range(rng.choice((1, 1, 3, 30))):
            if size:
                data[rng.randrange(size)] ^= 1 << rng.randrange(8)
    elif kind == "bytes":
        for _ in range(rng.choice((1, 4, 100))):
            if size:
                data[rng.randrange(min(size, rng.choice((64, 1 << 30))))] = rng.randrange(256)
    elif kind == "drop":
        del data[a : min(b, a + rng.choice((1, 8, 1000)))]
    elif kind == "repeat":
        data[a:a] = data[a : min(b, a + 4000)] * rng.choice((1, 2, 50))
    elif kind == "zeros":
        data[a:b] = bytes(b - a)
    elif kind == "number":
        form = rng.choice(("<I", "<Q", "<H", ">I", ">Q", ">H", "<d", ">d"))
        value: Any = rng.choice(NUMBERS) & ((1 << (8 * struct.calcsize(form))) - 1)
        if form[1] == "d":
            value = rng.choice((float("nan"), float("inf"), 1e308, -1e300, 0.0, 1e-320))
        at = rng.randrange(min(size, rng.choice((16, 64, 200, 1 << 30))) + 1) if size else 0
        packed = struct.pack(form, value)
        data[at : at + len(packed)] = packed
    elif kind == "append":
        data += rng.choice((b"\0" * 5000, b"\n1 2 3\n", rng.randbytes(100), bytes(data)))
    elif kind == "swap":
        middle = (a + b) // 2
        data[a:b] = data[middle:b] + data[a:middle]
    else:
        data = bytearray(rng.choice((b"", b"\0", b"\xff\xfe", b"[" * 100_000, b"\xef\xbb\xbf{}", rng.randbytes(300))))
    path.write_bytes(data)
    return f"{kind} {a}..{b} of {size} bytes, now {len(data)}"


def damage_text(rng: random.Random, path: Path) -> str:
    """A word or a line that is replaced, repeated or removed."""
    text = path.read_text(encoding="latin-1")
    parts = re.split(r"(\s+|[,\[\]{}:])", text)
    words = [n for n, part in enumerate(parts) if part.strip() and part not in ",[]{}:"]
    if not words:
        return "nothing"
    kind, at = rng.choice(("word", "word", "word", "repeat", "drop", "line", "encoding")), rng.choice(words)
    old = parts[at]
    if kind == "word":
        parts[at] = rng.choice(WORDS)
    elif kind == "repeat":
        parts[at] = " ".join([old] * rng.choice((2, 20, 20000)))
    elif kind == "drop":
        parts[at] = ""
    if kind == "line":
        lines = text.splitlines(keepends=True)
        n = rng.randrange(len(lines))
        lines[n : n + 1] = [lines[n]] * rng.choice((0, 2, 3000))
        parts = lines
    form = rng.choice(("utf-16", "utf-8-sig", "utf-32")) if kind == "encoding" else "latin-1"
    path.write_bytes("".join(parts).encode(form, "replace"))
    return f"{kind} {old[:30]!r} -> {parts[at][:30] if kind == 'word' else form!r}"


def damage_document(rng: random.Random, path: Path) -> str:
    """A value of a JSON document that is replaced by one of another type or an extreme one, or goes; nesting; a name
    that stands twice."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        return damage_bytes(rng, path)
    places = list(_places(content))
    if not places:
        return damage_bytes(rng, path)
    container, key = rng.choice(places)
    value = rng.choice(EXTREMES)
    told = f"{str(key)[:30]} = {ascii(value)[:40] if not isinstance(value, int) or value < 10**100 else 'huge'}"
    if rng.random() < 0.1:
        del container[key]
        value, told = None, f"without {key}"
    else:
        container[key] = "@@" if isinstance(value, int) and value > 10**100 else value
    text = json.dumps(content)
    if isinstance(value, int) and value > 10**100:
        text = text.replace('"@@"', "1" + "0" * (400 if value == 10**400 else 5000))
    kind = rng.random()
    if kind < 0.04:
        text, told = text.replace("{", '{"frames": [], "camera": 1, "frames": 2,', 1), "names that stand twice"
    elif kind < 0.08:
        text, told = text.replace(":", ": " + "[" * 10_000 + "]" * 10_000 + ', "z":', 1), "nesting"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return told


def _places(content: Any) -> Any:
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in list(items):
        yield content, key
        yield from _places(value)


def damage_archive(rng: random.Random, path: Path) -> str:
    """A member of a ZIP that is damaged, goes, stands twice, is a bomb, or has another name."""
    with zipfile.ZipFile(path) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    at = 0 if rng.random() < 0.4 else rng.randrange(len(members))
    name, data = members[at]
    kind = rng.choice(("content", "content", "content", "drop", "twice", "bomb", "name", "many"))
    told = kind
    if kind == "content":
        inner = path.with_name(Path(name).name)
        inner.write_bytes(data)
        told = (
            rng.choice((damage_bytes, damage_text, damage_document))(rng, inner)
            if at == 0
            else damage_bytes(rng, inner)
        )
        members[at] = name, inner.read_bytes()
        inner.unlink()
    elif kind == "drop":
        del members[at]
    elif kind == "twice":
        members.append((name, data[: len(data) // 2]))
    elif kind == "bomb":
        members[at] = name, data + bytes(rng.choice((1 << 20, 300 << 20)))
    elif kind == "name":
        named = rng.choice(
            ("../outside", "/etc/passwd", "rgbd\\0.jpg", "rgbd/../../0.jpg", "é" * 200, "rgbd/", "a\x01b")
        )
        members[at] = named, data
        told = f"named {named[:20]!r}"
    else:
        members += [(f"rgbd/{n}.jpg", b"") for n in range(5000, 25_000)]
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a name that stands twice
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if kind == "bomb" else method) as archive:
            for member, content in members:
                archive.writestr(member, content)
    return f"{name} in {path.name}: {told}"


def damage_image(rng: random.Random, path: Path) -> str:
    """Another size in the header, another kind of image, a bomb, or a part of a PNG with a right sum."""
    import cv2
    import numpy as np

    data = bytearray(path.read_bytes())
    kind = rng.choice(("size", "size", "kind", "bomb", "chunk", "format"))
    sides = rng.choice((0, 1, 31, 4000, 12000, 65535)), rng.choice((0, 1, 24, 5000, 12000, 65535))
    if kind == "size":
        if data.startswith(b"\x89PNG"):
            struct.pack_into(">II", data, 16, *(side * rng.choice((1, 1, 30000)) & 0x7FFFFFFF for side in sides))
            struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
        elif (at := max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))) >= 0:
            struct.pack_into(">HH", data, at + 5, *sides)
        elif data.startswith(b"BM"):
            struct.pack_into("<ii", data, 18, sides[0] * 30000, -sides[1])
        else:
            data += bytes(max(0, 16 - len(data)))
            struct.pack_into("<HH", data, rng.randrange(8, min(len(data) - 3, 40)), *sides)
        path.write_bytes(data)
        return f"states {sides}"
    if kind == "chunk" and data.startswith(b"\x89PNG") and len(data) > 60:
        body = bytearray(data[33:-12])
        body[rng.randrange(4, len(body))] ^= 1 << rng.randrange(8)
        name = rng.choice((b"acTL", b"fcTL", b"iCCP", b"zTXt", b"tRNS", b"PLTE", b"IHDR", b"IDAT", b"eXIf", b"fdAT"))
        inner = rng.randbytes(rng.choice((0, 1, 8, 26, 300)))
        chunk = struct.pack(">I", len(inner)) + name + inner + struct.pack(">I", zlib.crc32(name + inner))
        path.write_bytes(data[:33] + chunk + data[33:])
        return f"with a chunk {name!r} of {len(inner)} bytes"
    if kind == "bomb":
        side, dtype = rng.choice((3000, 11000)), rng.choice((np.uint8, np.uint16))
        suffix = rng.choice((".png", ".png", ".jpg", ".webp")) if dtype == np.uint8 else ".png"
        if suffix == ".webp":
            side = 3000  # writing a larger one takes more than a gigabyte, which would count as that of reading it
        image = np.zeros((side, side), dtype)
        options = [cv2.IMWRITE_PNG_COMPRESSION, 1] if suffix == ".png" else []
        path.write_bytes(cv2.imencode(suffix, image, options)[1].tobytes())
        return f"{side} x {side} zeros as {suffix}"
    if kind == "kind":
        shape = rng.choice(((24, 32), (24, 32, 3), (24, 32, 4), (1, 1), (24, 1), (48, 64)))
        dtype = rng.choice((np.uint8, np.uint16))
        image = np.random.default_rng(rng.randrange(1 << 30)).integers(0, 256, shape).astype(dtype)
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        return f"{shape} {dtype.__name__}"
    suffix = rng.choice((".tif", ".webp", ".bmp", ".jpg", ".jp2", ".gif", ".ppm", ".hdr", ".avif", ".exr"))
    image = np.full((24, 32, 3), rng.randrange(256), np.uint8)
    try:
        path.write_bytes(bytes(cv2.imencode(suffix, image)[1]))
    except (cv2.error, TypeError):
        path.write_bytes(b"")
    return f"as {suffix}"


def replace(rng: random.Random, path: Path) -> str:
    """What stands in the file's place: a pipe, a socket, a device, a link, a folder, nothing."""
    kind = rng.choice(("pipe", "socket", "device", "loop", "dangling", "folder", "nothing", "outside", "proc"))
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        here = os.getcwd()
        os.chdir(path.parent)  # the path of a socket is short
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name[-90:])
        os.chdir(here)
    elif kind == "device":
        path.symlink_to(rng.choice(("/dev/zero", "/dev/full", "/dev/urandom", "/dev/null")))
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "dangling":
        path.symlink_to(path.with_name("nowhere"))
    elif kind == "folder":
        path.mkdir()
    elif kind == "outside":
        path.symlink_to(rng.choice(("/etc/hostname", "/usr/bin/env", "/proc/self/environ")))
    elif kind == "proc":
        path.symlink_to(rng.choice(("/proc/self/maps", "/proc/self/mem", "/proc/kmsg", "/sys/kernel/notes")))
    return f"{kind} in its place"


def damage_folder(rng: random.Random, folder: Path) -> str:
    """Strange names, loops of folders, something else in place of a folder."""
    kind = rng.choice(("name", "name", "loop", "pipe", "many", "long", "double"))
    if kind == "name":
        name = rng.choice(
            (b"\xff.png", b"frame\n7.png", b"\xb2.png", b"7" * 240 + b".png", b"\x1b[31m9.jpg", b"-1.txt")
        )
        Path(os.fsdecode(os.path.join(os.fsencode(folder), name))).write_bytes(rng.randbytes(20))
        return f"{folder.name}: with a file {name[:20]!r}"
    if kind == "loop":
        (folder / "images").symlink_to(folder) if not (folder / "images").exists() else None
        (folder / "sparse").symlink_to(folder / "sparse") if not (folder / "sparse").exists() else None
    elif kind == "pipe":
        for inner in ("pose", "semantic_class", "depth", "images"):
            if not (folder / inner).exists():
                os.mkfifo(folder / inner)
    elif kind == "many":
        for n in range(3000):
            (folder / f"{n}.png").touch()
    elif kind == "long":
        (folder / ("9" * 250 + ".txt")).touch()
    else:
        for path in sorted(folder.iterdir())[:1]:
            if path.is_file():
                (folder / f"0{path.name}").write_bytes(path.read_bytes())
    return f"{folder.name}: {kind}"
