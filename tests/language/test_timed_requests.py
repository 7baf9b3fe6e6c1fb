"""Requests end in time, whatever a server does: real connections with raw bytes."""

from __future__ import annotations

import errno
import time
import urllib.request

import pytest
from hostile_servers import Connection, Script, attacking

from freeocc3d.language.timed_requests import Answer, NoAnswer, fetch

OK = b"HTTP/1.1 200 OK\r\n"


def fetched(url: str, timeout_s: float = 5.0, redirects: bool = False, least_bytes: int = 0) -> tuple[Answer, bytes]:
    body = bytearray()
    request = urllib.request.Request(url, headers={"Authorization": "Bearer secret"})
    receive = lambda _, piece: body.extend(piece)  # noqa: E731
    return fetch(request, receive, timeout_s, redirects=redirects, least_bytes=least_bytes), bytes(body)


def dripping(start: bytes, forever: bytes) -> Script:
    def script(connection: Connection) -> None:
        connection.send(start)
        connection.drip(forever)

    return script


DRIPS = {
    "silence": dripping(b"", b""),
    "status": dripping(b"", b"HTTP/1.1 200 OK "),
    "headers": dripping(OK, b"X: y"),
    "many headers": dripping(OK, b"X: y\r\n"),
    "continue": dripping(b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
    "body": dripping(OK + b"\r\n", b" "),
    "chunks": dripping(OK + b"Transfer-Encoding: chunked\r\n\r\n", b"1\r\n \r\n"),
    "body of an error": dripping(b"HTTP/1.1 400 No\r\n\r\n", b" "),
    "known length": dripping(OK + b"Content-Length: 1000000\r\n\r\n", b" "),
}


@pytest.mark.parametrize("drip", DRIPS)
@pytest.mark.parametrize("least_bytes", [0, 1000])
def test_one_deadline_holds_for_the_whole_exchange(drip: str, least_bytes: int) -> None:
    with attacking(DRIPS[drip]) as server:
        began = time.monotonic()
        with pytest.raises(TimeoutError):
            fetched(server.url, 0.3, least_bytes=least_bytes)
        assert time.monotonic() - began < 2


def test_answers_without_end_are_given_up() -> None:
    def script(connection: Connection) -> None:
        while not connection.over.is_set():
            connection.send(b"HTTP/1.1 100 Continue\r\n\r\n" * 1000)

    with attacking(script) as server, pytest.raises(TimeoutError):
        fetched(server.url, 0.3)


def test_a_slow_download_goes_on_while_it_goes_on() -> None:
    def script(connection: Connection) -> None:
        connection.send(OK + b"Content-Length: 10000\r\n\r\n")
        for _ in range(10):
            connection.send(bytes(1000))
            connection.over.wait(0.05)

    with attacking(script) as server:
        _, body = fetched(server.url, 0.2, least_bytes=1000)
    assert len(body) == 10000


@pytest.mark.parametrize(
    "answer",
    [
        b"", b"\r\n", b"not HTTP at all\r\n\r\n", b"HTTP/1.1 twohundred OK\r\n\r\n", b"HTTP/9.9 200 OK",
        OK + b"X: " + b"y" * 100_000, OK + b"X: y\r\n" * 200 + b"\r\n",
        OK + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n", OK + b"Transfer-Encoding: chunked\r\n\r\n-5\r\nabc\r\n",
        OK + b"Transfer-Encoding: chunked\r\n\r\n" + b"f" * 100_000,
        OK + b"Transfer-Encoding: chunked\r\n\r\n5\r\nab",
    ],
)  # fmt: skip
def test_what_is_no_http_is_no_answer(answer: bytes) -> None:
    with attacking(lambda connection: connection.send(answer)) as server, pytest.raises(NoAnswer):
        fetched(server.url, 2.0)


@pytest.mark.parametrize("error", [KeyError("enough"), OSError(errno.ENOSPC, "enough"), ValueError("enough")])
def test_what_the_receiver_raises_ends_the_exchange(error: Exception) -> None:
    def script(connection: Connection) -> None:
        connection.send(OK + b"\r\n")
        while not connection.over.is_set():
            connection.send(bytes(1 << 16))

    def receive(_: Answer, __: bytes) -> None:
        raise error

    with attacking(script) as server, pytest.raises(type(error), match="enough") as raised:
        fetch(urllib.request.Request(server.url), receive, 5.0)
    assert raised.value is error


def moved(to: bytes) -> Script:
    return lambda connection: connection.send(
        b"HTTP/1.1 302 Found\r\nLocation: " + to + b"\r\nContent-Length: 0\r\n\r\n"
    )


def test_redirects_are_followed_on_request_without_the_key() -> None:
    asked: list[bytes] = []

    def final(connection: Connection) -> None:
        asked.append(connection.request)
        connection.send(OK + b"Content-Length: 2\r\n\r\nhi")

    with attacking(final) as other, attacking(moved(other.url.encode())) as first:
        assert fetched(first.url)[0].status == 302
        assert fetched(first.url, redirects=True)[1] == b"hi"
    assert b"secret" not in asked[0]


@pytest.mark.parametrize("to", [b"/again", b"file:///etc/passwd", b"ftp://127.0.0.1/x", b"//", b"x:"])
def test_redirects_that_lead_nowhere_are_not_followed(to: bytes) -> None:
    with attacking(moved(to)) as server:
        assert fetched(server.url, redirects=True)[0].status == 302


def test_a_redirect_to_no_address_is_no_answer() -> None:
    with attacking(moved(b"http://[::1")) as server, pytest.raises(NoAnswer):
        fetched(server.url, redirects=True)
