"""The program accepts every command in the documentation: names, arguments, options, settings."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
import yaml

from freeocc3d.cli.main import app
from freeocc3d.settings import config, registry
from freeocc3d.settings.presets import find_preset

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
EXAMPLES = {"tripod", "brightness", "csv"}
"""Backends that CONTRIBUTING.md adds."""


def commands_of(page: Path) -> Iterator[str]:
    """Lines of the page's code blocks that call freeocc3d, joined where they go on, and calls within a sentence."""
    text = page.read_text(encoding="utf-8")
    for block in re.findall(r"^ *```\w*\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE):
        for line in re.sub(r"\\\n *", "", block).splitlines():
            if found := re.match(r"\s*(?:\S+/|printf .* \| )?freeocc3d (?!-- )(.*)", line):
                yield found[1]
    yield from re.findall(r"`freeocc3d ([^`]*)`", text)


def words_of(command: str) -> list[str]:
    return shlex.split(command, comments=True)


COMMANDS = [
    pytest.param(command, id=f"{page.relative_to(ROOT)}: {command[:60]}")
    for page in PAGES
    for command in commands_of(page)
]


def parsed(words: list[str]) -> tuple[str, dict[str, object]]:
    """The command's name and its values, as typer reads them; nothing runs."""
    command, name = typer.main.get_command(app), "freeocc3d"
    while children := getattr(command, "commands", None):
        if not words or words[0].startswith("-") or words[0] == "COMMAND":
            command.make_context(name, ["info", "MAP"], resilient_parsing=True)
            return "", {}
        assert words[0] in children, f"there is no command '{words[0]}'"
        name, command, words = f"{name} {words[0]}".removeprefix("freeocc3d "), children[words[0]], words[1:]
    if "--help" in words or not words:
        return name, {}
    with command.make_context(name, words) as context:
        return name, context.params


def test_commands_are_found() -> None:
    assert len(COMMANDS) > 100


@pytest.mark.parametrize("command", COMMANDS)
def test_a_documented_command_parses(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    words = words_of(command)
    if words and words[0] in typer.main.get_command(app).commands and len(words) > 1:  # type: ignore[attr-defined]
        words = [word for word in words if word not in ("…", "...")]
    name, values = parsed(words)
    given = [override for override in values.get("overrides") or [] if not EXAMPLES & set(re.split(r"[.=]", override))]  # type: ignore[attr-defined]
    if values.get("config_file") and values["config_file"] != Path("my.yaml"):
        assert "MAP" in str(values["config_file"]) or find_preset(str(values["config_file"])).is_file()
    if name in ("reconstruct", "evaluate"):
        assert not config.load(None, [override for override in given if "…" not in override]).notices
    if name == "export" and values["format_name"] not in EXAMPLES | {"NAME"}:
        known = {option.name for option in registry.backend("export", str(values["format_name"])).options}
        assert {override.partition("=")[0] for override in given} <= known


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_documented_settings_exist(page: Path) -> None:
    """Configurations in YAML blocks, and section.key or section.key=value in running text."""
    text = page.read_text(encoding="utf-8")
    sections = "|".join(config.SECTIONS)
    for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL):
        values = yaml.safe_load(block)
        if isinstance(values, dict) and set(values) <= set(config.SECTIONS):
            given = [f"{s}.{key}={value}" for s, keys in values.items() for key, value in keys.items()]
            assert not config.load(None, given).notices
    for said in re.findall(rf"`((?:{sections})(?:\.[a-z_]+)+(?:=[^`…]+)?)`", text):
        name, _, value = said.partition("=")
        if not EXAMPLES & set(re.split(r"[.=]", said)) and not re.search(r"\.(npz|ply|png|py|txt|yaml)$", name):
            assert not config.load(None, [f"{name}={value or default_of(name)}"]).notices


def default_of(name: str) -> str:
    """What the key has when nothing is set, as YAML."""
    section, *keys = name.split(".")
    found: object = yaml.safe_load((ROOT / "configs" / "default.yaml").read_text(encoding="utf-8"))[section]
    for key in keys:
        assert isinstance(found, dict)
        assert key in found, f"there is no option '{name}'"
        found = found[key]
    return yaml.safe_dump(found, default_flow_style=True, width=1000).replace("...", "").strip()
