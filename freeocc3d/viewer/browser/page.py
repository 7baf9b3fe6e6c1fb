"""The page of the viewer and its parts: scripts, which import each other by name, and a style sheet."""

from __future__ import annotations

import base64
import functools
import json
from collections.abc import Mapping
from importlib import resources

from ... import __version__
from ..self_contained_pages import make_environment

_SCRIPTS = (
    "three", "packets", "sources", "drawn_scene", "voxels", "splats", "colorings", "camera_path", "navigation", "boxes",
    "panels", "answers", "linked_frames", "viewer", "side_by_side",
)  # fmt: skip
"""Scripts of ``page/``, NAME.js; ``three`` is three.min.js."""

CONTENT_TYPES = {"js": "text/javascript", "css": "text/css"}


@functools.cache
def page_part(name: str) -> bytes | None:
    """Returns a file of the page; None for a name that is none of its parts."""
    if name != "style.css" and name not in {f"{script}.js" for script in _SCRIPTS}:
        return None
    file = "three.min.js" if name == "three.js" else name
    return (resources.files(__package__) / "page" / file).read_bytes()


def live_page(maps: int) -> str:
    """Returns the page that a server of some maps sends. Its addresses are relative."""
    imports = {script: f"./parts/{script}.js" for script in _SCRIPTS}
    return _fill(imports, "./parts/style.css", "viewer" if maps == 1 else "side_by_side", "", "{}")


def whole_page(packet: str, facts: Mapping[str, object], title: str) -> str:
    """Returns a page that needs no other file. packet: a compressed packet in base64.  facts: JSON for the script."""
    imports = {script: _as_source(f"{script}.js", "text/javascript") for script in _SCRIPTS}
    return _fill(imports, _as_source("style.css", "text/css"), "viewer", packet, _in_script(facts), title)


def _fill(imports: dict[str, str], style: str, start: str, packet: str, facts: str, title: str = "freeocc3d") -> str:
    template = make_environment("viewer/browser/page").get_template("viewer.html")
    return template.render(
        imports=_in_script({"imports": imports}), style=style, start=start, packet=packet, facts=facts, title=title,
        version=__version__,
    )  # fmt: skip


def _as_source(name: str, kind: str) -> str:
    content = page_part(name)
    assert content is not None
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _in_script(value: object) -> str:
    """Returns JSON that cannot end the element <script> that it stands in."""
    return (
        json.dumps(value, allow_nan=False)
        .replace("<", "\\u003c")
        .replace("\u2028", "\\u2028")
        .replace("\u2029", "\\u2029")
    )
