"""Serves maps to browsers until it is stopped."""

from __future__ import annotations

import errno
import secrets
import socket
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path

from ...core.errors import FreeOccError
from .live_map import LiveMap
from .shown_map import ShownMap

PORT = 8080
_TRIED = 20  # ports after the usual one, if it is taken and none was asked for
_LOCAL = ("localhost", "127.0.0.1", "::1")


def serve_maps(
    paths: Sequence[Path],
    host: str = "127.0.0.1",
    port: int | None = None,
    browse: bool = True,
    ready: Callable[[str], None] = print,
    live: bool = False,
) -> None:
    """Serves maps until Ctrl-C. Elsewhere than on this machine (``host``), an address needs a token, which is new each
    time.

    port: ``PORT``, or the next free one, if None; 0 = any free one.  browse: open a browser.  ready: is told the
    address when it answers.  live: wait for maps that are being made. Raises MapError for a folder that is no map,
    FreeOccError for a host or port that cannot be used.
    """
    import uvicorn

    from .server import make_app

    maps = [LiveMap(path) if live else ShownMap(path) for path in paths]
    local = host in _LOCAL
    token = "" if local else secrets.token_urlsafe(16)
    listening = _listen(host, port)
    shown = "localhost" if local else host if host not in ("0.0.0.0", "::") else socket.gethostname()
    address = f"http://{f'[{shown}]' if ':' in shown else shown}:{listening.getsockname()[1]}/{token and token + '/'}"

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            ready(address)
            if browse:
                webbrowser.open(address)

    settings = uvicorn.Config(make_app(maps, token, local), log_level="warning", lifespan="off", access_log=False)
    Server(settings).run(sockets=[listening])


def _listen(host: str, port: int | None) -> socket.socket:
    """Returns a socket that listens. Raises FreeOccError."""
    ports = range(PORT, PORT + _TRIED) if port is None else [port]
    for each in ports:
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, each, type=socket.SOCK_STREAM)[0]
            opened = socket.socket(family, kind, protocol)
            try:
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                opened.bind(address)
                opened.listen(64)
            except OSError:
                opened.close()
                raise
        except OSError as error:
            if error.errno == errno.EADDRINUSE and each != ports[-1]:
                continue
            taken = " is taken: choose another --port" if error.errno == errno.EADDRINUSE else f": {error.strerror}"
            raise FreeOccError(f"Cannot listen on {host}, port {each}{taken}.") from error
        return opened
    raise AssertionError(ports)
