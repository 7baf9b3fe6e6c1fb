"""Questions to a vision-language model over HTTP: a real server with every kind of answer."""

from __future__ import annotations

import base64
import socket
from http.server import BaseHTTPRequestHandler
from typing import Any

import cv2
import numpy as np
import pytest
from hostile_servers import Connection, attacking
from vision_servers import Answer, chat, saying, send, serving

from freeocc3d.core.errors import ConfigError
from freeocc3d.language.vision_server import ServerError, VisionServer, resolve_address, shorten_to_line

JPEG = cv2.imencode(".jpg", np.full((8, 12, 3), 200, np.uint8))[1].tobytes()
KEY = "sk-geheim-0123456789"


def asking(url: str, pauses: list[float] | None = None, **given: Any) -> VisionServer:
    return VisionServer(url, "a-model", **{"timeout": 5.0, "sleep": (pauses or []).append, **given})


def failing(answer: Answer, told: str, final: bool, asked: int = 1, **given: Any) -> str:
    """The error message about a server, and the number of requests."""
    with serving(answer) as server, pytest.raises(ServerError, match=told) as caught:
        asking(server.url, **given).ask("What?", JPEG)
    assert caught.value.final == final
    assert len(server.asked) == asked
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250
    return str(caught.value)


def test_a_picture_is_sent_with_the_question_and_the_key() -> None:
    with serving(saying('["chair"]')) as server:
        assert asking(server.url, key=KEY).ask("What?", JPEG) == '["chair"]'
    (body,) = server.asked
    text, picture = body["messages"][0]["content"]
    assert (server.paths, body["model"], text["text"]) == (["/v1/chat/completions"], "a-model", "What?")
    head, _, data = picture["image_url"]["url"].partition(",")
    assert head == "data:image/jpeg;base64"
    assert base64.b64decode(data) == JPEG
    assert server.headers[0]["Authorization"] == f"Bearer {KEY}"


def test_without_a_key_none_is_sent() -> None:
    with serving(saying("[]")) as server:
        asking(server.url).ask("What?", JPEG)
    assert "Authorization" not in server.headers[0]


def test_a_local_server_is_asked_without_a_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    monkeypatch.delenv("no_proxy", raising=False)
    with serving(saying("[]")) as server:
        assert asking(server.url).ask("What?", JPEG) == "[]"


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("http://localhost:8000/v1", "http://localhost:8000/v1/chat/completions"),
        ("http://localhost:8000/v1/", "http://localhost:8000/v1/chat/completions"),
        ("http://localhost:11434", "http://localhost:11434/v1/chat/completions"),
        ("https://example.org/openai/v1/chat/completions", "https://example.org/openai/v1/chat/completions"),
        ("http://[::1]:8080/v1", "http://[::1]:8080/v1/chat/completions"),
    ],
)
def test_addresses(endpoint: str, expected: str) -> None:
    assert resolve_address(endpoint) == expected


@pytest.mark.parametrize(
    ("endpoint", "told"),
    [
        ("localhost:8000", "must be an address"),
        ("file:///etc/passwd", "must be an address"),
        ("ftp://example.org/v1", "must be an address"),
        ("http://", "must be an address"),
        ("http://host:port/v1", "must be an address"),
        ("http://host/v1\r\nX: y", "must be an address"),
        ("http://h\u00f6st/v1", "must be an address"),
        (f"http://{'a' * 300}/v1", "must be an address"),
        ("", "must be an address"),
        ("https://me:secret@example.org/v1", "api_key_env"),
        ("https://example.org/v1?key=secret", "api_key_env"),
    ],
)
def test_what_is_no_address_is_refused(endpoint: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told) as caught:
        resolve_address(endpoint)
    assert "secret" not in str(caught.value)


def test_a_busy_server_is_asked_again_when_it_says() -> None:
    left = [(429, {"Retry_After": "7"}), (503, {}), (200, {})]

    def answer(handler: BaseHTTPRequestHandler, _: Any) -> None:
        status, headers = left.pop(0)
        send(handler, chat("[]"), status, **headers)

    pauses: list[float] = []
    with serving(answer) as server:
        assert VisionServer(server.url, "m", sleep=pauses.append).ask("What?", JPEG) == "[]"
    assert pauses == [7.0, 2.0]


def test_a_server_that_stays_busy_is_given_up_and_never_waited_for_long() -> None:
    pauses: list[float] = []

    def answer(handler: BaseHTTPRequestHandler, _: Any) -> None:
        send(handler, b'{"error": {"message": "overloaded"}}', 503, Retry_After="99999")

    with serving(answer) as server, pytest.raises(ServerError, match="answers 503: overloaded"):
        VisionServer(server.url, "m", retries=3, sleep=pauses.append).ask("What?", JPEG)
    assert len(server.asked) == 4
    assert max(pauses) <= 30


@pytest.mark.parametrize(("status", "final"), [(401, True), (404, True), (400, False), (413, False)])
def test_refused_questions_are_not_repeated(status: int, final: bool) -> None:
    def answer(handler: BaseHTTPRequestHandler, _: Any) -> None:
        send(handler, b'{"error": "no model\\n a-model \\u001b[31m"}', status)

    assert failing(answer, f"answers {status}: no model a-model", final).isprintable()


def test_a_key_that_the_server_quotes_is_not_shown() -> None:
    def answer(handler: BaseHTTPRequestHandler, _: Any) -> None:
        send(handler, f'{{"error": {{"message": "Incorrect API key provided: {KEY}."}}}}'.encode(), 401)

    assert KEY not in failing(answer, r"\(key\)", True, key=KEY)


def test_a_redirect_does_not_carry_the_key_away() -> None:
    with serving(saying("[]")) as other:

        def answer(handler: BaseHTTPRequestHandler, _: Any) -> None:
            send(handler, b"", 302, Location=other.url)

        failing(answer, "answers 302", True, key=KEY)
    assert not other.asked


def test_no_server_at_all() -> None:
    with socket.socket() as held:  # bound, and nobody listens
        held.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{held.getsockname()[1]}/v1"
        pauses: list[float] = []
        with pytest.raises(ServerError, match="cannot be reached") as caught:
            VisionServer(url, "m", sleep=pauses.append).ask("What?", JPEG)
    assert caught.value.final
    assert len(pauses) == 2


def test_a_server_that_never_answers_is_not_waited_for() -> None:
    with serving(lambda *_: None) as server:

        def silent(handler: BaseHTTPRequestHandler, _: Any) -> None:
            server.released.wait(20)

        with serving(silent) as slow:
            with pytest.raises(ServerError, match=r"within 0\.2 s"):
                asking(slow.url, timeout=0.2, retries=1).ask("What?", JPEG)
            server.released.set()
        assert len(slow.asked) == 2


def test_a_server_that_sends_a_byte_now_and_then_is_not_waited_for() -> None:
    with serving(lambda *_: None) as server:

        def dripping(handler: BaseHTTPRequestHandler, _: Any) -> None:
            handler.send_response(200)
            handler.end_headers()
            while not server.released.wait(0.02):
                handler.wfile.write(b" ")

        with serving(dripping) as slow:
            with pytest.raises(ServerError, match=r"within 0\.3 s"):
                asking(slow.url, timeout=0.3, retries=0).ask("What?", JPEG)
            server.released.set()


def test_an_endless_answer_is_not_read_to_its_end() -> None:
    written = [0]

    def endless(handler: BaseHTTPRequestHandler, _: Any) -> None:
        handler.send_response(200)
        handler.end_headers()
        while written[0] < 1 << 30:
            handler.wfile.write(b"[" * 65536)
            written[0] += 65536

    failing(endless, "sends more than", False)
    assert written[0] < 1 << 28


@pytest.mark.parametrize(
    "body",
    [
        b"", b"<html>busy</html>", b"[]", b"{}", b'{"choices": []}', b'{"choices": [{}]}', b'{"choices": [[1]]}',
        b'{"choices": [{"message": "hello"}]}', b"\xff\xfe\x00", b"[" * 100_000, b'{"choices": ' + b"9" * 5000 + b"}",
        b"null", chat("x")[:-20],
    ],
)  # fmt: skip
def test_answers_that_are_none_are_reported(body: bytes) -> None:
    failing(lambda handler, _: send(handler, body), "does not answer like a chat endpoint", False)


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (chat("hello"), "hello"),
        (chat(None, refusal="I cannot help with that."), ""),
        (chat("partly", refusal="I cannot."), ""),
        (chat(None), ""),
        (chat(7), ""),
        (chat([{"type": "text", "text": "a"}, {"type": "image"}, {"text": 3}, "b", {"text": "c"}]), "a\nc"),
    ],
)
def test_texts_of_answers(body: bytes, text: str) -> None:
    with serving(lambda handler, _: send(handler, body)) as server:
        assert asking(server.url).ask("What?", JPEG) == text


def test_one_line_is_fit_to_be_shown() -> None:
    assert shorten_to_line("a\n\tb\x1b[31m  c\u202e" + 100 * "d", 9) == "a b [31m "[:9]


@pytest.mark.parametrize(
    ("start", "forever"),
    [
        (b"HTTP/1.1 200 OK\r\n", b"X-Y: z\r\n"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", b" "),
        (b"HTTP/1.1 503 Busy\r\nContent-Length: 4000\r\n\r\n", b" "),
        (b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
        (b"", b"HTTP/1.1 200 OK "),
    ],
)
def test_the_timeout_holds_for_headers_and_bodies_of_errors_too(start: bytes, forever: bytes) -> None:
    def script(connection: Connection) -> None:
        connection.send(start)
        connection.drip(forever)

    with attacking(script) as server, pytest.raises(ServerError, match=r"within 0\.3 s"):
        asking(server.url, timeout=0.3, retries=1).ask("What?", JPEG)
    assert server.connections == 2


SHAPES = [b'{"choices": [{"message": {"content": NaN}}]}', b'{"choices": {"0": {}}}', b"\x1f\x8b" * 99]


@pytest.mark.parametrize("body", SHAPES)
def test_an_answer_of_another_shape_is_reported(body: bytes) -> None:
    failing(lambda handler, _: send(handler, body, Content_Encoding="gzip"), "does not answer like a chat", False)
