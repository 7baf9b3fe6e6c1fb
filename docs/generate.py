"""What of the site is generated when it is built: a hook of mkdocs (see mkdocs.yml).

The command line comes from typer's own application, the options from the registry, the Python pages from the files of
the package (mkdocstrings reads their docstrings), the release notes and the contributor's page from the files at the
top of the repository. Nothing heavy is imported.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "freeocc3d"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    sys.path.insert(0, str(ROOT))
    pages = {
        "reference/command-line.md": command_line(),
        "reference/options.md": options(),
        "reference/backends.md": backends(),
        "contributing.md": of_the_top("CONTRIBUTING.md"),
        "release-notes.md": of_the_top("CHANGELOG.md"),
    }
    pages |= {f"reference/python/{room}.md": python_room(room) for room in rooms()}
    for path, content in pages.items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """On the page for Python, a link [`Name`][] leads to where the package defines that name, wherever that is; on that
    for maps, MANIFEST_KEYS is a table of them."""
    if page.file.src_uri == "reference/map-format.md":
        return markdown.replace("MANIFEST_KEYS", manifest_table())
    if page.file.src_uri == "reference/python/index.md":
        return re.sub(r"\[`(\w+)`\]\[\]", lambda found: f"[`{found[1]}`][{defined(found[1])}]", markdown)
    return markdown


def manifest_table() -> str:
    """The keys of map.yaml, from the manifest's type."""
    from freeocc3d.storage.manifest import manifest_keys

    rows = ["| key | |", "|---|---|"]
    for key in manifest_keys():
        optional = "" if key.required else " (optional)"
        rows.append(f"| `{key.name}` | {_cell(key.description)}{optional} |")
    return "\n".join(rows)


def defined(name: str) -> str:
    """Dotted name of the one class or function of that name in the package, the command line aside."""
    places = [
        ".".join(("freeocc3d", *path.relative_to(PACKAGE).with_suffix("").parts, name))
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.parent.name != "cli"
        and re.search(rf"^(?:class|def) {name}\b", path.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    if len(places) != 1:
        raise PluginError(f"'{name}' is defined in {len(places)} places: {', '.join(places)}")
    return places[0]


def of_the_top(name: str) -> str:
    """A file of the repository's top as a page of the site: its links into docs/ become links of the site."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return re.sub(r"\]\(docs/", "](", text)


def command_line() -> str:
    """Every command with its arguments and options, from typer's application."""
    import typer

    from freeocc3d.cli.main import app

    lines = [
        "# Command line",
        "",
        "Exit status: 0 done; 1 a known error, in one line on stderr; 2 wrong usage. Results go to stdout, progress "
        "and warnings to stderr. `--json` prints one JSON document and nothing else. `--debug` shows the traceback of "
        "an error. `freeocc3d COMMAND --help` prints what stands here.",
        "",
    ]
    root = typer.main.get_command(app)
    for words, command in _commands(root, ("freeocc3d",)):
        lines += _command(words, command)
    return "\n".join(lines) + "\n"


def _commands(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Leaves of the tree of commands, with the words that call them."""
    children = getattr(command, "commands", {})
    if not children:
        yield words, command
    for name, child in children.items():
        yield from _commands(child, (*words, name))


def _command(words: tuple[str, ...], command: Any) -> list[str]:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    others = [p for p in command.params if p.param_type_name == "option" and not p.hidden and p.name != "help"]
    usage = " ".join([*words, "[OPTIONS]", *(p.metavar or p.human_readable_name for p in arguments)])
    lines = [f"## `{' '.join(words)}`", "", inspect.cleandoc(command.help or ""), "", "```text", usage, "```", ""]
    rows = [(f"`{p.metavar or p.human_readable_name}`", p.help, p.rich_help_panel) for p in arguments]
    rows += [(_names(p), f"{p.help or ''}{_default(p)}", p.rich_help_panel) for p in others]
    panels = dict.fromkeys(panel for *_, panel in rows)
    for panel in panels:
        lines += [*([f"**{panel}**", ""] if panel else []), "| | |", "|---|---|"]
        lines += [f"| {name} | {_cell(text)} |" for name, text, own in rows if own == panel]
        lines.append("")
    return lines


def _names(option: Any) -> str:
    value = "" if option.is_flag else f" {option.metavar or 'VALUE'}"
    return ", ".join(f"`{name}{value}`" for name in option.opts)


def _default(option: Any) -> str:
    """What the option is when it is not given, where that says something."""
    shown = option.show_default if isinstance(option.show_default, str) else option.default
    says_nothing = shown is None or shown == () or option.is_flag or callable(shown)
    return "" if says_nothing else f" Default: {shown if isinstance(option.show_default, str) else f'`{shown}`'}."


def options() -> str:
    """Every option of ``--set`` and of configuration files, by section."""
    from freeocc3d.settings.default_yaml import default_yaml

    lines = [
        "# Options",
        "",
        "Set an option with `--set section.key=value`, or in a YAML file for `--config`: see "
        "[Options and configurations](../how-to/options.md). `freeocc3d list --yaml` prints the same as a file. "
        "Exporters have options of their own: see [Backends](backends.md#exporters).",
        "",
        "```yaml",
        default_yaml().rstrip(),
        "```",
    ]
    return "\n".join(lines) + "\n"


def backends() -> str:
    """Readers, trackers, rasterizers, encoders and exporters with what they need and their options."""
    from freeocc3d.settings import registry

    lines = [
        "# Backends",
        "",
        "Each is one file of its folder. [Contributing](../contributing.md) shows how to add one. "
        "`freeocc3d list` prints this page, and says what is not installed.",
        "",
    ]
    for folder, title in registry.FOLDERS.items():
        lines += [f"## {title.split()[-1].capitalize()}s", "", f"`freeocc3d/{folder.replace('.', '/')}/`", ""]
        for backend in registry.backends(folder).values():
            needs = f" Needs {', '.join(f'`{name}`' for name in backend.requires)}." if backend.requires else ""
            lines += [f"### `{backend.name}`", "", f"{_cell(backend.summary)}{needs}", ""]
            if backend.options:
                lines += ["| option | type | default | |", "|---|---|---|---|"]
            for o in backend.options:
                doc = f"(advanced) {o.doc}" if o.advanced else o.doc
                lines.append(f"| `{o.name}` | {_cell(o.type)} | `{_cell(repr(o.default))}` | {_cell(doc)} |")
            lines.append("")
    return "\n".join(lines) + "\n"


def rooms() -> list[str]:
    """The rooms in the order of imports, as the package's docstring lists them."""
    told = ast.get_docstring(ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))) or ""
    return [line.split()[0] for line in told.splitlines() if re.match(r" {4}\w+ ", line)]


def python_room(room: str) -> str:
    """The public names of every file of a room."""
    folder = PACKAGE / room
    title = _summary(folder / "__init__.py")
    lines = [f"# `freeocc3d.{room}`", "", title, ""]
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[-1] not in ("__init__", "__main__"):
            lines += [f"## `{'.'.join(parts[1:])}`", "", f"::: freeocc3d.{'.'.join(parts)}", *_SHOWN, ""]
    return "\n".join(lines)


_SHOWN = ("    options:", "      show_root_heading: false", "      show_root_toc_entry: false")


def _summary(path: Path) -> str:
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def _cell(text: str | None) -> str:
    """Text in one cell of a table."""
    return " ".join((text or "").split()).replace("|", "\\|").replace("<", "&lt;")
