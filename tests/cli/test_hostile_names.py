"""Names from outside are shown in lines that only hold printable characters, and exactly in JSON."""

import ast
import json
import re
from pathlib import Path

import pytest
from command_line import SMALL, refused, run
from made_once import make_once

import freeocc3d.cli
from freeocc3d.capture import class_files
from freeocc3d.capture.builtin.builtin_room import CLASSES
from freeocc3d.query.scan_map import load_map

PATTERNS = (
    "red \x1b[31mbed\x1b[0m", "a\x1b]0;title\x07b", "wall\nsofa: 3 regions", "over\rwritten", "bell\x07", "\x9b2J",
    "a\tb", "\u202etxt.exe", "\u2066iso\u2069", "line\u2028break", "del\x7f", "zero\u200bwidth",
)  # fmt: skip
"""Escape sequences of terminals, breaks of lines, and what turns writing around."""

NAMES = [f"{PATTERNS[k % len(PATTERNS)]} {k}" for k in range(len(CLASSES))]


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def make(path: Path) -> None:
        names = path.with_name("names.json")
        names.write_text(json.dumps({"classes": NAMES}))
        words = "--set", "language.encoder=labels", "--set", f"language.labels.classes={names}"
        with pytest.MonkeyPatch.context() as patch:  # class files with these are refused, maps from elsewhere are not
            patch.setattr(class_files, "_NOT_TEXT", re.compile("(?!)"))
            assert shown("reconstruct", "builtin:room", "-o", path, *SMALL, *words)

    return make_once(tmp_path_factory, "map-\x1b[31m-of-names", make)


def shown(*arguments: object, lines: str = "") -> str:
    done = run(*arguments, lines=lines)
    assert all(line.isprintable() for line in (done.stdout + done.stderr).split("\n"))
    return done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ("info",), ("objects",), ("check",), ("query", "--classes"), ("query", *NAMES), ("query", "--objects", *NAMES),
        *[("query", "--class", name) for name in NAMES[1:4]],
    ],
    ids=lambda arguments: " ".join(arguments)[:20].encode("unicode_escape").decode(),
)  # fmt: skip
def test_lines_hold_printable_characters_only(hostile: Path, arguments: tuple[str, ...]) -> None:
    said = shown(arguments[0], hostile, *arguments[1:])
    assert "\\x1b[31m" in said or arguments[0] in ("check", "objects", "query")


def test_a_name_is_one_line(hostile: Path) -> None:
    vocabulary = load_map(hostile).vocabulary
    assert set(vocabulary) <= set(NAMES)
    assert len(shown("query", hostile, "--classes").splitlines()) == len(vocabulary) > 20


def test_a_line_of_the_input_is_answered_in_printable_lines(hostile: Path) -> None:
    first, second = shown("query", hostile, "--interactive", lines="bed\x1b[2J\nwall\x07\n").splitlines()
    assert first.startswith("bed\\x1b[2J: no match")
    assert second.startswith("wall\\x07: ")


def test_what_is_refused_is_said_in_a_printable_line(hostile: Path) -> None:
    assert refused("query", hostile, "--class", "no\x1b[31m\nsuch").isprintable()


def test_json_holds_names_exactly(hostile: Path) -> None:
    document = json.loads(run("query", hostile, "--json", *NAMES[1:]).stdout)
    assert [result["word"] for result in document["results"]] == NAMES[1:]
    assert document["map"] == str(hostile)


def test_only_the_console_prints() -> None:
    folder = Path(freeocc3d.cli.__file__).parent
    printing = {
        path.name
        for path in folder.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if (isinstance(node, ast.Name) and node.id == "print")
        or (isinstance(node, ast.Attribute) and node.attr in ("echo", "secho", "write", "writelines"))
    }
    assert printing == {"console.py"}
