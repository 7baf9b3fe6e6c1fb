"""Queries a vision-language model with an OpenAI-compatible endpoint: vLLM, Ollama, llama.cpp, or a hosted one.

A query is one call, POST …/chat/completions, with a picture as a data URL. Each failure gives a message of one
sentence.
Source: the chat completions API, https://platform.openai.com/docs/api-reference/chat.
"""

from __future__ import annotations

import base64
import json
import time
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import msgspec

from ..core.errors import ConfigError, FreeOccError
from .timed_requests import Answer, NoAnswer, fetch

_MOST_BYTES = 1 << 20  # largest answer
_MOST_TOKENS = 1024
_LONGEST_PAUSE_S = 30.0
_AGAIN = {408, 409, 425, 429, 500, 502, 503, 504}
"""Status codes after which the same question may succeed later."""
_FOREVER = {301, 302, 303, 307, 308, 401, 403, 404, 405}
"""Status codes that every other question would get, too."""
_LOCAL = {"localhost", "127.0.0.1", "::1"}


class ServerError(FreeOccError):
    """An endpoint did not answer; the message is one sentence. final: whether other questions will get no answer
    either."""

    def __init__(self, text: str, final: bool):
        super().__init__(text)
        self.final = final


@dataclass(frozen=True)
class VisionServer:
    """endpoint: http or https address, with or without /v1 and /chat/completions.  key: sent as a bearer token, never
    part of a message.  timeout: seconds for one answer.  retries: number of times that a question is repeated."""

    endpoint: str
    model: str
    key: str | None = None
    timeout: float = 60.0
    retries: int = 2
    sleep: Callable[[float], None] = time.sleep

    def ask(self, question: str, jpeg: bytes) -> str:
        """Returns the text of the answer; empty for a refusal. Raises ServerError."""
        picture = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
        content = [{"type": "text", "text": question}, {"type": "image_url", "image_url": {"url": picture}}]
        body = {
            "model": self.model,
            "messages": [{"role": "user", "content": content}],
            "max_tokens": _MOST_TOKENS,
            "temperature": 0,
        }
        for attempt in range(self.retries + 1):
            try:
                return self._text_of(self._post(json.dumps(body).encode()))
            except _Again as error:
                if attempt == self.retries:
                    raise ServerError(str(error), error.final) from error
                self.sleep(min(max(error.pause_s, 2.0**attempt), _LONGEST_PAUSE_S))
        raise AssertionError("unreachable")

    def _post(self, body: bytes) -> bytes:
        """The body of the answer. Raises _Again, ServerError."""
        headers = {"Content-Type": "application/json", "Accept": "application/json", "User-Agent": "freeocc3d"}
        if self.key:
            headers["Authorization"] = f"Bearer {self.key}"
        url = resolve_address(self.endpoint)
        request = urllib.request.Request(url, body, headers, method="POST")
        received = bytearray()

        def receive(_: Answer, piece: bytes) -> None:
            received.extend(piece)
            if len(received) > _MOST_BYTES:
                raise ServerError(f"{url} sends more than {_MOST_BYTES:,} bytes", final=False)

        try:
            answer = fetch(request, receive, self.timeout, proxies=urlsplit(url).hostname not in _LOCAL)
        except TimeoutError as error:
            raise _Again(f"{url} does not answer within {self.timeout:g} s", final=False) from error
        except NoAnswer as error:
            raise _Again(f"{url} cannot be reached: {self._cleaned(str(error))}") from error
        if answer.succeeded:
            return bytes(received)
        said = self._cleaned(_message(answer.excerpt))
        text = f"{url} answers {answer.status}{f': {said}' if said else ''}"
        if answer.status in _AGAIN:
            raise _Again(text, _seconds(answer.headers.get("Retry-After")), final=False)
        raise ServerError(text, final=answer.status in _FOREVER)

    def _text_of(self, body: bytes) -> str:
        try:
            message = msgspec.json.decode(body, type=_Reply).choices[0].message
        except (msgspec.MsgspecError, IndexError, RecursionError) as error:
            said = self._cleaned(body[:80].decode(errors="replace"))
            raise ServerError(
                f"{resolve_address(self.endpoint)} does not answer like a chat endpoint: '{said}'", False
            ) from error
        content = message.content
        if isinstance(content, list):  # parts, as some servers send them
            texts = [part.get("text") for part in content if isinstance(part, dict)]
            content = "\n".join(text for text in texts if isinstance(text, str))
        return "" if message.refusal or not isinstance(content, str) else content

    def _cleaned(self, text: str) -> str:
        """One short line without the key, which some servers quote."""
        return shorten_to_line(text.replace(self.key, "(key)") if self.key else text, 120)


def shorten_to_line(text: str, length: int) -> str:
    """The start of a text from another program, made safe to print on one line."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:length]


def resolve_address(endpoint: str) -> str:
    """The URL for chat completions. Raises ConfigError for other than http or https addresses, or one with a
    password."""
    try:
        parts = urlsplit(endpoint)
        usable = parts.scheme in ("http", "https") and bool((parts.hostname or "").encode("idna"))
        _ = parts.port
    except ValueError:  # an impossible port or host
        usable = False
    if not usable or not endpoint.isascii() or any(c.isspace() or not c.isprintable() for c in endpoint):
        raise ConfigError(f"The endpoint '{endpoint}' must be an address such as http://localhost:8000/v1.")
    if parts.username or parts.password or parts.query or parts.fragment:
        raise ConfigError(
            "The endpoint must not contain a password or a query, because it is saved in the map. Put the key into an "
            "environment variable, and name the variable in vocabulary.api_key_env."
        )
    path = parts.path.rstrip("/")
    if not path.endswith("/chat/completions"):
        path = (path or "/v1") + "/chat/completions"
    return f"{parts.scheme}://{parts.netloc}{path}"


class _Again(Exception):
    """The question may be asked again."""

    def __init__(self, text: str, pause_s: float = 0.0, final: bool = True):
        super().__init__(text)
        self.pause_s, self.final = pause_s, final


class _Message(msgspec.Struct):
    content: Any = None
    refusal: Any = None


class _Choice(msgspec.Struct):
    message: _Message


class _Reply(msgspec.Struct):
    """What is used of an answer."""

    choices: list[_Choice]


def _message(excerpt: bytes) -> str:
    """A server's message about an error, or the start of its body."""
    try:
        said = msgspec.json.decode(excerpt, type=dict[str, Any])["error"]
        return str(said["message"] if isinstance(said, dict) else said)
    except (msgspec.MsgspecError, KeyError, RecursionError):
        return excerpt.decode(errors="replace")


def _seconds(text: str | None) -> float:
    """Seconds in a Retry-After header; 0 for dates and invalid text."""
    return float(text) if text and text.isascii() and text.isdigit() and len(text) < 6 else 0.0
