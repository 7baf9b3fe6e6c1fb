"""The server of the viewer: pages, packets of maps, answers. It serves the shown maps and nothing else of the machine.

Addresses, below the token if there is one: the page; ``parts/NAME``, its own files; ``maps``, a list; and of map M:
``maps/M/state``, ``scene``, ``space``, ``keyframes/K.jpg``, and by POST with JSON ``query``, ``views``, ``voxel``.
"""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, TypeVar

import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from ...core.errors import FreeOccError
from .answers import Asked, describe_voxel
from .page import CONTENT_TYPES, live_page, page_part
from .shown_map import ShownMap

_LARGEST_BODY = 1 << 16
_LOCAL = ("localhost", "127.0.0.1", "::1")
_SAFE = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'self' data:; script-src 'self' 'unsafe-inline'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; frame-ancestors 'self'",
}
_PACKET = {"Content-Encoding": "gzip"}
T = TypeVar("T")


class _ViewsOf(msgspec.Struct, forbid_unknown_fields=True):
    answer: int
    region: int


class _VoxelOf(msgspec.Struct, forbid_unknown_fields=True):
    row: int


class _Guard:
    """Lets requests in that name this machine or carry the token, and gives every answer safe headers. A page of
    another site can neither reach the maps by a name that it makes point here, nor post from its own origin."""

    def __init__(self, app: ASGIApp, local: bool, token: str):
        self._app, self._local, self._token = app, local, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        refused = self._refused(request)

        async def guarded(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message["headers"],
                    *((k.lower().encode(), v.encode()) for k, v in _SAFE.items()),
                ]
            await send(message)

        if refused:
            await JSONResponse({"error": refused}, 403)(scope, receive, guarded)
            return
        if self._token:
            scope["path"] = scope["path"][len(self._token) + 1 :] or "/"
            scope["raw_path"] = scope["path"].encode()
        await self._app(scope, receive, guarded)

    def _refused(self, request: Request) -> str:
        host = request.headers.get("host", "")
        if self._local and host.rsplit(":", 1)[0].strip("[]").lower() not in _LOCAL:
            return "This viewer answers this machine only: open it as http://localhost."
        origin = request.headers.get("origin")
        if origin is not None and origin.split("://", 1)[-1] != host:
            return "This viewer answers its own page only."
        first, slash, _ = request.url.path.removeprefix("/").partition("/")
        if self._token and not (slash and hmac.compare_digest(first.encode(), self._token.encode())):
            return "This address lacks the token: open the whole address that 'freeocc3d view' printed."
        return ""


def make_app(maps: Sequence[ShownMap], token: str = "", local: bool = True) -> Starlette:
    """Returns the server of some maps. token: first part of every address; none if empty.  local: whether it answers
    only requests for names of this machine."""

    async def page(request: Request) -> Response:
        return Response(live_page(1 if "map" in request.query_params else len(maps)), media_type="text/html")

    async def part(request: Request) -> Response:
        name = request.path_params["name"]
        if (content := page_part(name)) is None:
            raise HTTPException(404, f"The viewer has no part {name}.")
        return Response(content, media_type=CONTENT_TYPES[name.rsplit(".", 1)[-1]])

    async def listed(request: Request) -> Response:
        return JSONResponse([{"name": shown.path.resolve().name, "capture": shown.capture} for shown in maps])

    def of_map(work: Callable[[ShownMap, Request], Response]) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            if not 0 <= (number := request.path_params["map"]) < len(maps):
                raise HTTPException(404, f"The viewer shows no map {number}.")
            if request.method == "POST":
                await _read_body(request)
            return await run_in_threadpool(work, maps[number], request)

        return endpoint

    routes = [
        Route("/", page),
        Route("/parts/{name}", part),
        Route("/maps", listed),
        Route("/maps/{map:int}/state", of_map(lambda shown, _: JSONResponse({"version": shown.version}))),
        Route("/maps/{map:int}/scene", of_map(lambda shown, _: _packet(shown.scene()))),
        Route("/maps/{map:int}/space", of_map(lambda shown, _: _packet(shown.space()))),
        Route("/maps/{map:int}/keyframes/{row:int}.jpg", of_map(_photograph)),
        Route("/maps/{map:int}/query", of_map(lambda shown, asked: _packet(shown.ask(_body(asked, Asked)))),
              methods=["POST"]),
        Route("/maps/{map:int}/views", of_map(_views), methods=["POST"]),
        Route("/maps/{map:int}/voxel", of_map(_voxel), methods=["POST"]),
    ]  # fmt: skip
    guard = Middleware(_Guard, local=local, token=token)
    handlers: dict[Any, Any] = {FreeOccError: _known, HTTPException: _refusal}
    return Starlette(routes=routes, middleware=[guard], exception_handlers=handlers)


def _packet(compressed: bytes) -> Response:
    return Response(compressed, media_type="application/octet-stream", headers=_PACKET)


def _photograph(shown: ShownMap, request: Request) -> Response:
    return Response(shown.photograph(request.path_params["row"]), media_type="image/jpeg")


def _views(shown: ShownMap, request: Request) -> Response:
    about = _body(request, _ViewsOf)
    views = shown.views(about.answer, about.region)
    if views is None:
        raise HTTPException(410, "The answer is no longer kept: ask again.")
    return JSONResponse(views)


def _voxel(shown: ShownMap, request: Request) -> Response:
    row = _body(request, _VoxelOf).row
    return JSONResponse(shown.use(lambda scan_map: describe_voxel(scan_map, row)))


async def _read_body(request: Request) -> None:
    """Reads a request's body into its state. Raises HTTPException for one that is no JSON, or too long."""
    if request.headers.get("content-type", "").split(";")[0] != "application/json":
        raise HTTPException(415, "Questions are sent as application/json.")
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > _LARGEST_BODY:
            raise HTTPException(413, f"A question has at most {_LARGEST_BODY} bytes.")
    request.state.body = bytes(body)


def _body(request: Request, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(request.state.body, type=kind)
    except (msgspec.DecodeError, msgspec.ValidationError, UnicodeDecodeError, RecursionError) as error:
        raise HTTPException(400, f"The question is not understood: {error}.") from error


def _known(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, 422)


def _refusal(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code)
