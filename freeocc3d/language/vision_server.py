"""Asks a vision-language model behind an OpenAI-compatible endpoint: vLLM, Ollama, llama.cpp, or a hosted one.

One call, POST …/chat/completions, with a picture as a data URL; what may go wrong on the way is told in one sentence.
Standard library only. Source: the chat completions API, https://platform.openai.com/docs/api-reference/chat.
"""

from __future__ import annotations

import base64
import http.client
import json
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any
from urllib.parse import urlsplit

from ..core.errors import ConfigError, FreeOccError

_MOST_BYTES = 1 << 20  # of an answer
_MOST_TOKENS = 1024
_LONGEST_PAUSE_S = 30.0
_AGAIN = {408, 409, 425, 429, 500, 502, 503, 504}
"""Statuses after which the same question may be answered later."""
_FOREVER = {301, 302, 303, 307, 308, 401, 403, 404, 405}
"""Statuses that any other question would have, too."""
_LOCAL = {"localhost", "127.0.0.1", "::1"}


class ServerError(FreeOccError):
    """An endpoint did not answer; the message is one sentence. final: whether it will not answer other questions."""

    def __init__(self, text: str, final: bool):
        super().__init__(text)
        self.final = final


@dataclass(frozen=True)
class VisionServer:
    """endpoint: http or https address, with or without /v1 and /chat/completions.  key: sent as a bearer token, and
    never part of a message.  timeout: seconds for one answer.  retries: how often a question is asked again."""

    endpoint: str
    model: str
    key: str | None = None
    timeout: float = 60.0
    retries: int = 2
    sleep: Callable[[float], None] = time.sleep

    def ask(self, question: str, jpeg: bytes) -> str:
        """The text of the answer, empty for a refusal. Raises ServerError."""
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
        headers = {"Content-Type": "application/json", "Accept": "application/json", "User-Agent": "freeocc3d"}
        if self.key:
            headers["Authorization"] = f"Bearer {self.key}"
        url = resolve_address(self.endpoint)
        request = urllib.request.Request(url, body, headers, method="POST")
        no_proxy = [urllib.request.ProxyHandler({})] if urlsplit(url).hostname in _LOCAL else []
        opener = urllib.request.build_opener(_NoRedirects, *no_proxy)
        deadline = time.monotonic() + self.timeout
        try:
            with opener.open(request, timeout=self.timeout) as response:
                return self._read(response, deadline)
        except urllib.error.HTTPError as error:
            with error:
                said = self._cleaned(_excerpt(error))
            text = f"{url} answers {error.code}{f': {said}' if said else ''}"
            if error.code in _AGAIN:
                raise _Again(text, _seconds(error.headers.get("Retry-After")), final=False) from error
            raise ServerError(text, final=error.code in _FOREVER) from error
        except TimeoutError as error:
            raise _Again(f"{url} does not answer within {self.timeout:g} s", final=False) from error
        except (OSError, http.client.HTTPException) as error:  # URLError is an OSError
            reason = getattr(error, "reason", error)
            if isinstance(reason, TimeoutError):
                raise _Again(f"{url} does not answer within {self.timeout:g} s", final=False) from error
            raise _Again(f"{url} cannot be reached: {self._cleaned(str(reason) or 'the connection broke')}") from error

    def _read(self, response: IO[bytes], deadline: float) -> bytes:
        """The body, of which no more is kept than an answer may have. A server that sends a byte now and then does not
        hold a run up: ``timeout`` is for all of it."""
        body = bytearray()
        while chunk := response.read1(65536):  # type: ignore[attr-defined]
            body += chunk
            if len(body) > _MOST_BYTES:
                raise ServerError(
                    f"{resolve_address(self.endpoint)} sends more than {_MOST_BYTES:,} bytes", final=False
                )
            if time.monotonic() > deadline:
                raise TimeoutError
        return bytes(body)

    def _text_of(self, body: bytes) -> str:
        try:
            choice = json.loads(body)["choices"][0]
            message = choice["message"]
            content = message.get("content")
        except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
            said = self._cleaned(body[:80].decode(errors="replace"))
            raise ServerError(
                f"{resolve_address(self.endpoint)} does not answer as a chat does: '{said}'", False
            ) from error
        if isinstance(content, list):  # parts, as some servers send them
            texts = [part.get("text") for part in content if isinstance(part, dict)]
            content = "\n".join(text for text in texts if isinstance(text, str))
        return "" if message.get("refusal") or not isinstance(content, str) else content

    def _cleaned(self, text: str) -> str:
        """One short line without the key, which some servers quote."""
        return shorten_to_line(text.replace(self.key, "(key)") if self.key else text, 120)


def shorten_to_line(text: str, length: int) -> str:
    """The start of a text that came from elsewhere, fit to be shown."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:length]


def resolve_address(endpoint: str) -> str:
    """Where chats are completed. Raises ConfigError for what is no http or https address, or holds a password."""
    try:
        parts = urlsplit(endpoint)
        usable = parts.scheme in ("http", "https") and bool((parts.hostname or "").encode("idna"))
        _ = parts.port
    except ValueError:  # a port or a host that cannot be one
        usable = False
    if not usable or not endpoint.isascii() or any(c.isspace() or not c.isprintable() for c in endpoint):
        raise ConfigError(f"The endpoint '{endpoint}' must be an address like http://localhost:8000/v1.")
    if parts.username or parts.password or parts.query or parts.fragment:
        raise ConfigError(
            "The endpoint must hold neither a password nor a query, for it is written to the map: name the environment "
            "variable that has the key with vocabulary.api_key_env."
        )
    path = parts.path.rstrip("/")
    if not path.endswith("/chat/completions"):
        path = (path or "/v1") + "/chat/completions"
    return f"{parts.scheme}://{parts.netloc}{path}"


class _Again(Exception):
    """A question that may be asked again."""

    def __init__(self, text: str, pause_s: float = 0.0, final: bool = True):
        super().__init__(text)
        self.pause_s, self.final = pause_s, final


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """A redirect would take the key to another address."""

    def redirect_request(self, *_: Any) -> None:
        return None


def _excerpt(error: urllib.error.HTTPError) -> str:
    """What a server says about an error: its message, or the start of its body."""
    try:
        text = error.read(4096).decode(errors="replace")
    except (OSError, http.client.HTTPException):
        return ""
    try:
        said = json.loads(text)["error"]
        return str(said["message"] if isinstance(said, dict) else said)
    except (ValueError, KeyError, TypeError, RecursionError):
        return text


def _seconds(text: str | None) -> float:
    """Of a Retry-After header; dates and nonsense are 0."""
    return float(text) if text and text.isascii() and text.isdigit() and len(text) < 6 else 0.0
