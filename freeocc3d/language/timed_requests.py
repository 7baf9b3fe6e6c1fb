"""HTTP requests that end in time, whatever a server does.

A timeout of a socket holds for each wait alone, so a server that sends a byte now and then keeps a caller for ever: in
the TLS handshake, the status line, the headers, "100 Continue" answers or the body. Here an exchange runs in a thread
of its own. When its time is over, its connection is shut down and the caller goes on.
"""

from __future__ import annotations

import http.client
import queue
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple
from urllib.parse import urlsplit

_AT_ONCE = 1 << 16
_EXCERPT = 4096
_LAST_WAIT_S = 1.0
"""Time for the thread of an ended exchange to notice."""


class Answer(NamedTuple):
    """status: of HTTP.  excerpt: the start of the body of an answer that is no success."""

    status: int
    headers: Mapping[str, str]
    excerpt: bytes = b""

    @property
    def succeeded(self) -> bool:
        """Whether the body is what was asked for."""
        return 200 <= self.status < 300


class NoAnswer(Exception):
    """The server cannot be reached, or breaks the protocol. The text says why."""


def fetch(
    request: urllib.request.Request,
    receive: Callable[[Answer, bytes], None],
    timeout_s: float,
    *,
    least_bytes: int = 0,
    redirects: bool = False,
    proxies: bool = True,
) -> Answer:
    """Send a request and hand the body of a success on, piece by piece, in another thread.

    receive: takes the answer and a piece of its body; what it raises ends the exchange.  timeout_s: for the whole
    exchange; with ``least_bytes``, for each that many bytes of the body instead.  redirects: follow them, without the
    authorization to another host.

    Raises TimeoutError, NoAnswer, and what ``receive`` raises.
    """
    exchange = _Exchange(request, receive, timeout_s)
    handlers = [_Handler(exchange), _Redirects() if redirects else _NoRedirects()]
    opener = urllib.request.build_opener(*handlers, *([] if proxies else [urllib.request.ProxyHandler({})]))
    thread = threading.Thread(target=exchange.run, args=(opener,), name="freeocc3d request", daemon=True)
    thread.start()
    try:
        return exchange.wait(least_bytes)
    finally:
        exchange.give_up()
        thread.join(_LAST_WAIT_S)


class _Exchange:
    """One request and its answer."""

    def __init__(self, request: urllib.request.Request, receive: Callable[[Answer, bytes], None], timeout_s: float):
        self._request, self._receive, self._timeout_s = request, receive, timeout_s
        self._received = 0
        self._ended: queue.SimpleQueue[Answer | Exception] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._connections: list[socket.socket] = []
        self._given_up = False

    def run(self, opener: urllib.request.OpenerDirector) -> None:
        """The exchange, in its own thread."""
        try:
            self._ended.put(self._answer(opener))
        except Exception as error:  # raised again in the caller's thread
            self._ended.put(error)

    def wait(self, least_bytes: int) -> Answer:
        """The answer, when its body is received."""
        while True:
            before = self._received
            try:
                ended = self._ended.get(timeout=self._timeout_s)
            except queue.Empty:
                if not least_bytes or self._received - before < least_bytes:
                    raise TimeoutError from None
                continue
            if isinstance(ended, Exception):
                raise ended
            return ended

    def connect(self, *arguments: Any, **options: Any) -> socket.socket:
        """Like socket.create_connection; the connection can then be shut down from another thread."""
        connection = socket.create_connection(*arguments, **options)
        with self._lock:
            self._connections.append(connection.dup())  # the same connection, also when TLS takes over the other
            given_up = self._given_up
        if given_up:
            self.give_up()
        return connection

    def give_up(self) -> None:
        """End the exchange now."""
        with self._lock:
            self._given_up = True
            connections, self._connections = self._connections, []
        for connection in connections:
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError:  # it has ended
                pass
            finally:
                connection.close()

    def _answer(self, opener: urllib.request.OpenerDirector) -> Answer:
        try:
            response = opener.open(self._request, timeout=self._timeout_s)
        except urllib.error.HTTPError as error:
            with error:
                return Answer(error.code, dict(error.headers), _excerpt(error))
        except Exception as error:
            raise _told(error) from error
        with response:
            answer = Answer(response.status, dict(response.headers))
            while piece := _next_piece(response):
                self._receive(answer, piece)
                self._received += len(piece)
            return answer


def _next_piece(response: http.client.HTTPResponse) -> bytes:
    try:
        return response.read1(_AT_ONCE)
    except Exception as error:
        raise _told(error) from error


def _excerpt(error: urllib.error.HTTPError) -> bytes:
    try:
        return error.read(_EXCERPT)
    except (OSError, ValueError, http.client.HTTPException):
        return b""


def _told(error: Exception) -> Exception:
    """The network's error as ``fetch`` raises it."""
    reason = error.reason if isinstance(error, urllib.error.URLError) else error
    if isinstance(error, TimeoutError) or isinstance(reason, TimeoutError):
        return TimeoutError()
    if isinstance(error, urllib.error.URLError | http.client.HTTPException | ConnectionError | UnicodeError) or (
        type(error) in (OSError, ValueError)  # of sockets and of chunks' sizes
    ):
        return NoAnswer(str(reason) or "the connection broke")
    return error


class _Handler(urllib.request.HTTPHandler, urllib.request.HTTPSHandler):
    """Takes the place of both default handlers; its connections can be ended."""

    def __init__(self, exchange: _Exchange):
        super().__init__()
        self._exchange = exchange

    def http_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_connecting(http.client.HTTPConnection, self._exchange), req)

    def https_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_connecting(http.client.HTTPSConnection, self._exchange), req)


def _connecting(kind: Any, exchange: _Exchange) -> Any:
    """Makes connections of a kind that the exchange can end."""

    def make(*arguments: Any, **options: Any) -> Any:
        connection = kind(*arguments, **options)
        connection._create_connection = exchange.connect
        return connection

    return make


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Refuses redirects, which would send the key to another address."""

    def redirect_request(self, *_: Any) -> None:
        return None


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to servers of no less safety."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        old, new = urlsplit(req.full_url), urlsplit(newurl)
        if new.scheme not in ("http", "https") or (old.scheme, new.scheme) == ("https", "http"):
            return None
        request = super().redirect_request(req, fp, code, msg, headers, newurl)
        if request is not None and new.netloc != old.netloc:
            request.remove_header("Authorization")
        return request
