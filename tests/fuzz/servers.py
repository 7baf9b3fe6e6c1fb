"""Hostile servers: of vision-language models, and hubs of model packages. Each answers with raw bytes at any pace."""

from __future__ import annotations

import functools
import gzip
import hashlib
import json
import os
import random
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from freeocc3d.language import model_hub
from freeocc3d.language.scene_vocabulary import parse_names
from freeocc3d.language.vision_server import VisionServer

from . import mutators
from .harness import Attack, Silent

sys.path.append(str(Path(__file__).parents[1] / "helpers"))
from hostile_servers import Connection, attacking

SHORT = 30

_TIMEOUT_S = 0.25
_REPOSITORY = "someone/tiny"
_STATUSES = (200, 200, 200, 201, 204, 206, 301, 302, 307, 400, 401, 404, 413, 429, 500, 503, 999, 100, 199, 0, -1)

Reply = Callable[[Connection], None]


def prepare(folder: Path) -> None:
    """Nothing: servers hold no files."""


def attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """One server with one behavior, asked by one client."""
    if rng.random() < 0.65:
        content, what = _chat(rng)
        reply, how = _reply(rng, content)
        return Attack(f"chat: {what}; {how}", functools.partial(_ask, reply))
    if rng.random() < 0.3:
        text, what = _answer_text(rng)
        return Attack(f"names: {what}", functools.partial(_parse, text))
    listing, what = _listing(rng)
    first, how = _reply(rng, listing)
    second, then = _reply(rng, rng.choice((b"", b"a: b", _manifest(rng), rng.randbytes(300))))
    return Attack(f"hub: {what}; {how}; {then}", functools.partial(_pull, first, second, folder))


def _ask(reply: Reply) -> None:
    with attacking(reply) as server:
        client = VisionServer(server.url, "a-model", "sk-key", _TIMEOUT_S, retries=1, sleep=lambda _: None)
        began = time.monotonic()
        try:
            parse_names(client.ask("What?", b"\xff\xd8\xff"))
        finally:
            if time.monotonic() - began > 10 + 2 * _TIMEOUT_S:
                raise Silent("the timeout did not hold")


def _parse(text: str) -> None:
    names = parse_names(text)
    if names is not None and not all(0 < len(name) <= 40 and name.isprintable() for name in names):
        raise Silent(f"a name that is none: {names!r:.200}")


def _pull(first: Reply, second: Reply, folder: Path) -> None:
    def reply(connection: Connection) -> None:
        (first if b"/api/models/" in connection.request else second)(connection)

    before = {name: os.environ.get(name) for name in ("HF_ENDPOINT", "FREEOCC3D_MODELS")}
    timeout, model_hub._TIMEOUT_S = model_hub._TIMEOUT_S, _TIMEOUT_S
    try:
        with attacking(reply) as server:
            os.environ["HF_ENDPOINT"], os.environ["FREEOCC3D_MODELS"] = server.url, str(folder / "models")
            model_hub.pull_package(_REPOSITORY)
    finally:
        model_hub._TIMEOUT_S = timeout
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        outside = [path.name for path in folder.iterdir() if path.name != "models"]
        if outside:
            raise Silent(f"files outside of the models folder: {outside}")


def _chat(rng: random.Random) -> tuple[bytes, str]:
    """The body of a chat's answer, sound or not."""
    text, what = _answer_text(rng)
    message: dict[str, Any] = {"role": "assistant", "content": text}
    body: Any = {"choices": [{"message": message}]}
    if rng.random() < 0.4:
        try:
            body, changed = mutators.change_value(rng, body)
            what = f"{what}, {changed}"
        except (ValueError, TypeError, RecursionError):
            body = []
    if rng.random() < 0.15:
        token = rng.choice(mutators.RAW_JSON)
        return rng.choice((token, '{"choices": [{"message": {"content": ' + token + "}}]}")).encode(
            "utf-8", "surrogatepass"
        ), f"{token!r:.40}"
    try:
        data = json.dumps(body).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):
        data = b"[" * 100_000
    if rng.random() < 0.1:
        data = gzip.compress(rng.choice((data, b" " * 10**7)))
        what += ", gzip"
    if rng.random() < 0.1:
        data = data[: rng.randrange(len(data) + 1)]
        what += ", cut"
    return data, what


def _answer_text(rng: random.Random) -> tuple[str, str]:
    """What a model says."""
    piece = rng.choice(
        ("\n", " ", "- ", "- x", "1. ", "[", "]", '["chair", "desk"]', "<think>", "</think>", "(", ")", "*", ",", ", ",
         "chair", "- chair\n", '{"name": "chair"}', "\u200b", "\u00a0", "\x1b[31m", "a b c d e f ", "é", "椅子", "\0",
         "\t", "`", "\u2028", "```json\n", '[{"name": 1}]', "-\n")
    )  # fmt: skip
    other = rng.choice(("", "y", "- y\n", '["lamp"]', "\n", "<think>"))
    times = rng.choice((1, 3, 100, 20_000, 200_000))
    return piece * times + other, f"{piece!r} x {times} + {other!r}"


def _listing(rng: random.Random) -> tuple[bytes, str]:
    """A hub's list of files."""
    name = rng.choice(
        ("manifest.yaml", "manifest.yaml", "manifest.json", "config.json", "model.safetensors", "../x", "a/b")
    )
    size = rng.choice((0, 5, 300, 10**6, 10**15, 2**70, -1, None, "5", 1.5))
    digest = hashlib.sha256(b"a: b").hexdigest()
    siblings = [{"rfilename": name, "size": size, "blobId": rng.choice((digest[:40], None, "x", 5))}]
    if rng.random() < 0.5:
        siblings[0]["lfs"] = {"sha256": rng.choice((digest, "0", None)), "size": size}
    if rng.random() < 0.2:
        siblings += [
            {"rfilename": other, "size": 1, "blobId": digest[:40]} for other in mutators.TEXTS if other.isascii()
        ]
    body: Any = {"id": _REPOSITORY, "siblings": siblings}
    what = f"{name} of {size}"
    if rng.random() < 0.4:
        try:
            body, changed = mutators.change_value(rng, body)
            what = f"{what}, {changed}"
        except (ValueError, TypeError, RecursionError):
            body = None
    try:
        return json.dumps(body).encode("utf-8", "surrogatepass"), what
    except (ValueError, RecursionError):
        return b"[" * 50_000, what


def _manifest(rng: random.Random) -> bytes:
    files = rng.choice(("{../x: 5}", "{}", "{a.onnx: " + "0" * 64 + "}", "[1]", "*a"))
    return f"format: 1\nname: x\nkind: dense\nfiles: {files}\nparts: {{image: a.onnx}}\n".encode()


def _reply(rng: random.Random, body: bytes) -> tuple[Reply, str]:
    """A way to send a body."""
    status = rng.choice(_STATUSES)
    headers = [b"Content-Type: " + rng.choice((b"application/json", b"text/html", b"image/png", b"\xff", b""))]
    length = rng.choice((len(body), len(body), len(body), 0, 1, len(body) + 100, 10**18, -5, "x", None))
    if length is not None:
        headers.append(f"Content-Length: {length}".encode())
    for _ in range(rng.choice((0, 0, 1, 3, 200))):
        headers.append(
            rng.choice((b"X: y", b"Retry-After: 99999", b"Retry-After: -1", b"Location: /again", b"Location: file:///etc",
                        b"Transfer-Encoding: chunked", b"Content-Encoding: gzip", b"X: " + b"y" * 70_000, b"no colon",
                        b"Connection: close", b"Set-Cookie: a=b", b": empty", b"Content-Range: bytes 5-9/3", b"\0: \0"))
        )  # fmt: skip
    start = rng.choice(
        (f"HTTP/1.1 {status} OK\r\n".encode(),) * 6
        + (b"HTTP/1.0 200\r\n", b"HTTP/1.1 200 OK\n", b"", b"\0\0", b"ICY 200 OK\r\n", b"HTTP/1.1 " + b"2" * 70_000,
           b"HTTP/1.1 100 Continue\r\n\r\nHTTP/1.1 200 OK\r\n")
    )  # fmt: skip
    chunks = rng.choice(
        (body, b"5\r\nabc", b"zz\r\n", b"-1\r\n", b"0\r\n\r\n", b"ffffffffff\r\nabc", b"1;x=" + b"y" * 70_000)
    )
    sent = chunks if b"Transfer-Encoding: chunked" in headers else body
    whole = start + b"\r\n".join(headers) + b"\r\n\r\n" + sent
    way = rng.choice(("whole", "whole", "whole", "whole", "whole", "cut", "drip", "stall", "reset", "flood", "again"))
    place = rng.choice((0, rng.randrange(len(whole) + 1), min(len(start), 15), len(whole) - len(sent)))
    described = f"{start[:30]!r} {len(headers)} headers, {way} at {place}"
    return functools.partial(
        _send, whole, way, place, rng.choice((b"x", b"X: y\r\n", b" ", b"HTTP/1.1 100 C\r\n\r\n"))
    ), described


def _send(whole: bytes, way: str, place: int, more: bytes, connection: Connection) -> None:
    if way == "whole":
        connection.send(whole)
        return
    connection.send(whole[:place])
    if way == "drip":
        connection.drip(whole[place:] + more, 0.01)
    elif way == "stall":
        connection.over.wait(5)
    elif way == "reset":
        connection.reset()
    elif way == "flood":
        while not connection.over.is_set():
            connection.send(more * 10_000)
    elif way == "again":
        connection.send(whole * 3)
