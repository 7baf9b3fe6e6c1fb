"""Debian's Chromium for tests of pages, which draws without a GPU and reaches nothing but this machine."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from benchmark.viewer import SWITCHES

from freeocc3d.viewer.browser.server import make_app
from freeocc3d.viewer.browser.shown_map import ShownMap


@contextmanager
def open_browser() -> Iterator[Any]:
    """Yields a browser of Playwright; skips the test if there is none."""
    sync_api = pytest.importorskip("playwright.sync_api")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("needs Chromium: sudo apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(SWITCHES))
        yield browser
        browser.close()


class Watched:
    """A page, and what it complains of: errors of scripts, warnings and errors in the console, failed requests."""

    def __init__(self, browser: Any, address: str, **options: Any):
        options.setdefault("viewport", {"width": 1000, "height": 700})
        self.context = browser.new_context(bypass_csp=True, reduced_motion="reduce", **options)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.page.on("pageerror", lambda error: self.complaints.append(f"{error}"))
        self.page.on("console", self._hear)
        self.page.goto(address)
        self.page.wait_for_function("document.documentElement.dataset.ready", timeout=60_000)
        self.settle()

    def _hear(self, message: Any) -> None:
        if message.type in ("error", "warning") and "GPU stall due to ReadPixels" not in message.text:
            self.complaints.append(message.text)

    def settle(self) -> None:
        """Waits until the page has drawn what was asked for."""
        self.page.wait_for_function("!freeocc3d.scene.pending && freeocc3d.scene.resting === undefined")

    def ask(self, words: str) -> None:
        """Types words and waits for the list of answers."""
        self.page.fill("input[name=words]", words)
        asked = self.page.evaluate("freeocc3d.asked")
        self.page.press("input[name=words]", "Enter")
        self.page.wait_for_function(f"freeocc3d.asked > {asked} && !document.querySelector('[aria-busy]')")
        self.settle()


@contextmanager
def serving(paths: Sequence[Path]) -> Iterator[str]:
    """Serves maps from this process, and yields the address. What the server logs is part of the captured log."""
    settings = uvicorn.Config(make_app([ShownMap(path) for path in paths]), port=0, log_level="warning", lifespan="off")
    server = uvicorn.Server(settings)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    yield f"http://localhost:{server.servers[0].sockets[0].getsockname()[1]}/"
    server.should_exit = True
    thread.join(10)
