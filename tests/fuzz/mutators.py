"""Damage that fits any file, text, JSON or YAML document. Each function returns what it did, in a few words."""

from __future__ import annotations

import json
import os
import random
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 0.0, -0.0, 1e-300, 1e300, 1e308, -1e308, 1e38, 3.5e38, 1e-7, 0.5, 2**31 - 1, 2**31, -(2**31), 2**53,
    2**63 - 1, 2**63, 2**64, -(2**63) - 1, 10**400, float("nan"), float("inf"), float("-inf"),
)  # fmt: skip
TEXTS: tuple[str, ...] = (
    "", " ", "\0", "a\0b", "../x", "/etc/passwd", ".", "..", "x" * 70_000, "é", "\ud800", "\u202e", "nan", "1", "-",
    "true", "2024-13-45", "a\nb", "color", "labels", "os", "a/b", "%s", "{}", "\x1b[31m",
)  # fmt: skip
RAW_YAML = (
    "2024-13-45", "2024-01-01", "!!int abc", "!!float x", "!!timestamp x", "!!bool x", "!!binary x", "!!set {a}",
    "!!python/object/apply:os.system ['true']", "&a [*a]", "*nothing", "{<<: {a: 1}}", "[" * 3000, "[" * 50 + "]" * 50,
    "9" * 5000, "0x" + "f" * 5000, ".nan", ".inf", "-.inf", "1e400", "'", '"', "|", ">", "{", "}", "~", "\t", "1:30:00",
    "1_000", "0o17", "[1, 2", "a: b: c", "? x", "- - - -", "%YAML 3.0", "---", "...", "\x00", "\x07", "é", "<<",
)  # fmt: skip
RAW_JSON = (
    "NaN", "Infinity", "-Infinity", "[" * 20_000, '{"a":' * 5000, "9" * 5000, "1e999", "-", "nul", "'x'", '"\\ud800"',
    "[" * 90 + "]" * 90, "1.0.0", "01", "\x00", "", "{}", "[]", "null", "true", '"x"', "-1", "1e308",
)  # fmt: skip
_MOST_PLACES = 20_000
ENCODINGS = ("utf-16", "utf-32", "utf-8-sig", "cp037")


def any_value(rng: random.Random, depth: int = 2) -> Any:
    """A value of another type, or an extreme one."""
    kind = rng.randrange(10)
    if kind < 4:
        return rng.choice(NUMBERS)
    if kind < 6:
        return rng.choice(TEXTS)
    if kind < 7 or not depth:
        return rng.choice((None, True, False, [], {}))
    if kind < 8:
        return _nested(rng.choice((3, 60, 200)))
    if kind < 9:
        return [any_value(rng, depth - 1) for _ in range(rng.choice((1, 2, 3, 4, 1000)))]
    return {rng.choice(("a", "name", "frames", "")): any_value(rng, depth - 1)}


def _nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def change_value(rng: random.Random, content: Any) -> tuple[Any, str]:
    """The content with one value somewhere replaced, removed, doubled or exchanged."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key, value in list(node.items() if isinstance(node, dict) else enumerate(node)):
            if len(places) > _MOST_PLACES:  # an earlier change made a bomb
                return
            places.append((node, key))
            if isinstance(value, dict | list):
                walk(value)

    if not isinstance(content, dict | list) or not content or rng.random() < 0.03:
        value = any_value(rng)
        return value, f"the whole content = {value!r:.60}"
    walk(content)
    # A document of many numbers has few of its other values: choose the key first.
    shallow = [(node, key) for node, key in places if isinstance(node, dict)]
    node, key = rng.choice(shallow if shallow and rng.random() < 0.6 else places)
    action = rng.randrange(8)
    if action == 0:
        del node[key]
        return content, f"without {key!r:.60}"
    if action == 1 and isinstance(node, dict):
        name = rng.choice((*TEXTS, "later"))
        node[name] = node.pop(key)
        return content, f"{key!r:.60} is named {name!r:.60}"
    if action == 2:
        other, place = rng.choice(places)
        value = other[place] if place in (other if isinstance(other, dict) else range(len(other))) else None
        node[key] = json.loads(json.dumps(value, default=str))
        return content, f"{key!r:.60} = that of {place!r:.60}"
    if action == 3 and isinstance(node[key], int | float) and not isinstance(node[key], bool):
        factor, more = rng.choice((-1, 2, 0.5, 1000, 1e-9)), rng.choice((0, 1, -1))
        node[key] = (node[key] if abs(node[key]) < 1e300 else 1e300) * factor + more
        return content, f"{key!r:.60} = {node[key]!r:.60}"
    if action == 4 and isinstance(node[key], list):
        values = node[key]
        node[key] = rng.choice((values[:-1], values + values, values[::-1], values + [any_value(rng)], []))
        return content, f"{key!r:.60} has {len(node[key])} instead of {len(values)} values"
    node[key] = any_value(rng)
    return content, f"{key!r:.60} = {node[key]!r:.60}"


def change_json(rng: random.Random, path: Path) -> str:
    """Change one value of a JSON file, or write one that is no JSON."""
    content, what = change_value(rng, json.loads(path.read_text(encoding="utf-8")))
    text = json.dumps(content)
    if rng.random() < 0.3:
        what, text = _raw_token(rng, text, rng.choice(RAW_JSON), ":,[")
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    return what


def change_yaml(rng: random.Random, path: Path) -> str:
    """Change one value of a YAML file, or write one that is no YAML."""
    text = path.read_text(encoding="utf-8")
    if rng.random() < 0.35:
        lines = text.splitlines()
        row = rng.randrange(len(lines))
        head = lines[row].partition(":")[0]
        token = rng.choice(RAW_YAML)
        lines[row] = rng.choice((f"{head}: {token}", token, f"{lines[row]} {token}", f"{head}: &x {token}"))
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return f"line {row + 1} = {lines[row]!r:.80}"
    if rng.random() < 0.05:
        bomb = ["l0: &l0 [x, x, x, x, x, x, x, x, x]"]
        bomb += [f"l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * 9)}]" for n in range(1, 10)]
        path.write_text("\n".join([text, *bomb]), encoding="utf-8")
        return "a billion laughs"
    content, what = change_value(rng, yaml.safe_load(text))
    try:
        dumped = yaml.safe_dump(content, sort_keys=False)
    except (yaml.YAMLError, RecursionError, ValueError):
        dumped, what = str(content), f"{what}, as Python shows it"
    path.write_text(dumped, encoding="utf-8", errors="surrogatepass")
    return what


def _raw_token(rng: random.Random, text: str, token: str, after: str) -> tuple[str, str]:
    places = [place for place, char in enumerate(text) if char in after] or [0]
    place = rng.choice(places) + 1
    end = min((found for found in (text.find(char, place) for char in ",]}") if found >= 0), default=len(text))
    return f"{token[:20]!r} at {place}", text[:place] + token + text[rng.choice((place, end)) :]


def change_lines(rng: random.Random, path: Path) -> str:
    """Remove, double, exchange or change lines or words of a text."""
    lines = path.read_text(encoding="utf-8").splitlines()
    row, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    action = rng.randrange(6)
    if action == 0:
        del lines[row]
    elif action == 1:
        lines.insert(other, lines[row])
    elif action == 2:
        lines[row], lines[other] = lines[other], lines[row]
    elif action == 3:
        lines[row] = str(rng.choice((*NUMBERS[:24], *TEXTS)))
    else:
        words = lines[row].split(" ")
        words[rng.randrange(len(words))] = str(rng.choice((*NUMBERS, *TEXTS)))
        lines[row] = " ".join(words)
    encoding = rng.choice(ENCODINGS) if rng.random() < 0.1 else "utf-8"
    path.write_bytes("\n".join(lines).encode(encoding, "replace"))
    return f"lines, kind {action}, row {row}, {encoding}"


def change_bytes(rng: random.Random, path: Path) -> str:
    """Cut, flip, double, exchange, remove or zero some bytes, or append others."""
    data = bytearray(path.read_bytes())
    if not data:
        data = bytearray(b"x")
    size = len(data)
    place = rng.choice(
        (rng.randrange(size), rng.randrange(min(size, 200)), max(size - 1 - rng.randrange(min(size, 200)), 0))
    )
    length = min(rng.choice((1, 2, 4, 16, 100, 5000)), size - place)
    action = rng.randrange(9)
    if action == 0:
        del data[place:]
    elif action in (1, 2):
        data[place] ^= 1 << rng.randrange(8)
    elif action == 3:
        data[place : place + length] = rng.randbytes(length)
    elif action == 4:
        data[place:] = bytes(size - place)
    elif action == 5:
        data[place:place] = data[place : place + length]
    elif action == 6:
        del data[place : place + length]
    elif action == 7:
        data[place : place + length] = rng.choice((b"\xff", b"\0", b"\x7f")) * length
    else:
        data += rng.choice((b"\0", b"\n", rng.randbytes(50)))
    path.write_bytes(data)
    return f"bytes, kind {action}, at {place} of {size}, {length} long"


def change_kind(rng: random.Random, path: Path) -> str:
    """Replace a file or folder by something that is no regular file, or remove it."""
    kinds: dict[str, Callable[[Path], object]] = {
        "a pipe": os.mkfifo,
        "a socket": _socket,
        "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
        "a link to /dev/stdin": lambda path: path.symlink_to("/dev/stdin"),
        "a link to itself": lambda path: path.symlink_to(path.name),
        "a link to nothing": lambda path: path.symlink_to("nothing"),
        "a link to outside": lambda path: path.symlink_to("/etc/passwd"),
        "a link to the folder above": lambda path: path.symlink_to(".."),
        "a folder": Path.mkdir,
        "empty": lambda path: path.write_bytes(b""),
        "missing": lambda path: None,
    }
    moved = path.with_name("moved")
    path.rename(moved)
    kind = rng.choice((*kinds, "a link inside", "a file without rights"))
    if kind == "a link inside":
        path.symlink_to("moved")
    elif kind == "a file without rights":
        moved.rename(path)
        path.chmod(0)
    else:
        kinds[kind](path)
    return kind


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as opened:
        here = os.open(path.parent, os.O_RDONLY)
        try:
            opened.bind(f"/proc/self/fd/{here}/{path.name}")  # a socket's path may be 100 characters long
        finally:
            os.close(here)
