"""A scene's vocabulary: names from all kinds of answers, counted over keyframes, kept for a resumed run."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from small_captures import color_image
from vision_servers import chat, saying, send, serving

from freeocc3d.core.errors import ConfigError
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.language import scene_vocabulary
from freeocc3d.language.scene_vocabulary import Namer, Options, aggregate_names, load_namer, parse_names
from freeocc3d.language.vision_server import VisionServer

MANY = [f"thing {chr(97 + n % 26)}{chr(97 + n // 26 % 26)}{chr(97 + n // 676)}" for n in range(10_000)]


def keyframes(count: int, size: tuple[int, int] = (32, 24)) -> list[Frame]:
    camera = Intrinsics(*size, 30, 30, 16, 12)
    depth = np.ones(size[::-1], np.float32)
    return [Frame(10 * n, float(n), color_image(n, size), depth, camera) for n in range(count)]


def namer(url: str, model: str = "a-model") -> Namer:
    options = Options(endpoint=url, model=model, timeout=5.0, retries=0)
    return Namer(options, VisionServer(url, model, timeout=5.0, retries=0))


def named(maker: Namer, path: Path, count: int = 4) -> tuple[dict[str, Any], list[str]]:
    return maker.names(keyframes(count), path / "answers.json", lambda done: None)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ('["Chair", "the tables", "chairs"]', ["chair", "table"]),
        ('```json\n["office chair",\n "wall"]\n```', ["office chair", "wall"]),
        ('Here you are: ["lamp"]. I hope it helps.', ["lamp"]),
        ('{"objects": ["lamp", "sofa"]}', ["lamp", "sofa"]),
        ('[{"name": "lamp", "box": [1, 2]}, {"label": "sofa"}, {"x": 1}, 3, null]', ["lamp", "sofa"]),
        ("<think>A [\"ghost\"]?\nMaybe.</think>[\"sofa\"]", ["sofa"]),
        ("<think>It never ends [\"ghost\"", None),
        ("- a chair\n- **floor lamp**\n- wall (white)", ["chair", "floor lamp", "wall"]),
        ("I see:\n1. chair\n2) table\n", ["chair", "table"]),
        ("chair, table, floor lamp, wall.", ["chair", "table", "floor lamp", "wall"]),
        ("стул, стол, стена", ["стул", "стол", "стена"]),
        ('["沙发", "床"]', ["沙发", "床"]),
        ("", None),
        ("chair", None),
        ("[]", None),
        ("[1, 2, 3]", None),
        ("I'm sorry, I can't help with that.", None),
        ("There is a table, a chair, and a lamp in this room.", None),
        ("The picture shows a cosy room with a large wooden table in the middle of it.", None),
        ('["' + "x" * 500 + '"]', None),
        ('["there is a table and a chair", "a very long name of one single thing"]', None),
        ("[" * 5000, None),
        (json.dumps(MANY), None),
        (json.dumps(["chair", "table"] * 5000), ["chair", "table"]),
        ('["\\ud800 lamp", "tea\\u0000pot", "so\\nfa"]', ["lamp", "tea pot", "so fa"]),
    ],
)  # fmt: skip
def test_names_in_answers(text: str, names: list[str] | None) -> None:
    assert parse_names(text) == names


def test_names_are_counted_over_keyframes_and_the_most_frequent_stand_first(tmp_path: Path) -> None:
    answers = ('["chair", "Walls"]', '["wall", "chair", "wall"]', '["chair"]', '["lamp"]')
    advanced: list[int] = []
    with serving(saying(*answers)) as server:
        found, warnings = namer(server.url).names(keyframes(4), tmp_path / "answers.json", advanced.append)
    assert warnings == []
    assert advanced == [1, 2, 3, 4]
    assert list(found["names"].items()) == [
        ("chair", {"count": 3, "keyframes": [0, 10, 20]}),
        ("wall", {"count": 2, "keyframes": [0, 10]}),
        ("lamp", {"count": 1, "keyframes": [30]}),
    ]
    assert (found["model"], found["keyframes"]) == ("a-model", [0, 10, 20, 30])
    assert json.loads(json.dumps(found)) == found
    assert server.asked[0]["messages"][0]["content"][0]["text"] == scene_vocabulary.QUESTION


def test_large_pictures_are_sent_smaller() -> None:
    jpeg = scene_vocabulary._jpeg(keyframes(1, (1280, 960))[0].color)
    sent = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert sent.shape == (576, 768, 3)
    assert sent[10, -10, 2] > 200 > 50 > sent[10, 10, 2]  # RGB: red grows to the right


def test_answers_that_name_nothing_are_reported_and_cost_nothing_else(tmp_path: Path) -> None:
    with serving(saying("I'm sorry,\x1b[31m I can't.", '["chair"]', "", '["chair"]')) as server:
        found, warnings = named(namer(server.url), tmp_path)
    assert found["names"] == {"chair": {"count": 2, "keyframes": [10, 30]}}
    assert len(warnings) == 1
    assert warnings[0].text.startswith(
        "2 of 4 answers of a-model contain no names. The first: 'I'm sorry, [31m I can't.'"
    )


def test_a_server_that_fails_now_and_then_costs_its_keyframes(tmp_path: Path) -> None:
    left = [500, 200, 500, 500, 200]

    def answer(handler: Any, _: Any) -> None:
        send(handler, chat('["chair"]'), left.pop(0))

    with serving(answer) as server:
        found, warnings = named(namer(server.url), tmp_path, 5)
    assert found["names"]["chair"]["keyframes"] == [10, 40]
    assert len(warnings) == 1
    assert "lacks 3 of 5 keyframes" in warnings[0].text
    assert "500" in warnings[0].text


@pytest.mark.parametrize(("status", "asked"), [(500, 3), (400, 3), (401, 1), (404, 1)])
def test_a_server_that_fails_always_is_not_asked_for_every_keyframe(tmp_path: Path, status: int, asked: int) -> None:
    with serving(lambda handler, _: send(handler, b"", status)) as server:
        found, warnings = named(namer(server.url), tmp_path, 9)
    assert len(server.asked) == asked
    assert found["names"] == {}
    assert "lacks 9 of 9" in warnings[0].text


def test_answers_are_kept_for_a_run_that_goes_on(tmp_path: Path) -> None:
    def stop(done: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with serving(saying('["chair"]')) as server:
        with pytest.raises(KeyboardInterrupt):
            namer(server.url).names(keyframes(4), tmp_path / "answers.json", stop)
        assert len(server.asked) == 2
        found, _ = named(namer(server.url), tmp_path)
        assert len(server.asked) == 4
        assert found["names"]["chair"]["count"] == 4
        named(namer(server.url, "another-model"), tmp_path)  # other questions: all are asked anew
        assert len(server.asked) == 8


@pytest.mark.parametrize("text", ["", "{", "[]", '{"of": 1}', '{"of": "x", "answers": {"a": ["b"]}}', "null"])
def test_kept_answers_that_cannot_be_read_are_asked_for_again(tmp_path: Path, text: str) -> None:
    (tmp_path / "answers.json").write_text(text)
    with serving(saying('["chair"]')) as server:
        assert named(namer(server.url), tmp_path)[0]["names"]["chair"]["count"] == 4


def test_no_endpoint_no_questions() -> None:
    assert load_namer(Options()) is None


def test_the_key_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    options = Options(endpoint="http://localhost/v1", model="m", api_key_env="SOME_KEY")
    monkeypatch.delenv("SOME_KEY", raising=False)
    with pytest.raises(ConfigError, match=r"SOME_KEY.*is not set"):
        load_namer(options)
    monkeypatch.setenv("SOME_KEY", "a\nb")
    with pytest.raises(ConfigError, match="not plain text") as caught:
        load_namer(options)
    assert "a\nb" not in str(caught.value)
    monkeypatch.setenv("SOME_KEY", " secret ")
    made = load_namer(options)
    assert made is not None
    assert made.server.key == "secret"


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ({"endpoint": "http://localhost/v1"}, "'model' must name the model"),
        ({"endpoint": "localhost", "model": "m"}, "must be an address"),
        ({"keyframes": 0}, "keyframes"),
        ({"timeout": 0.0}, "timeout"),
        ({"retries": -1}, "retries"),
    ],
)
def test_options_out_of_range_are_refused(bad: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        load_namer(Options(**bad))


def test_no_answers_make_an_empty_vocabulary() -> None:
    assert aggregate_names({}, "m") == {"model": "m", "keyframes": [], "names": {}}


@pytest.mark.parametrize(
    "text",
    ["\n" * 10**6, " " * 10**6, "- x" + " " * 10**6 + "y", "-\n" * 10**6, "[" * 10**6, "<think>" * 10**5, "(" * 10**6,
     "1. " * 10**6, "- " + "a " * 10**6, "[1," * 10**5, ("<think></think>" + "\t") * 10**5],
    ids=str.split("newlines spaces gap bullets brackets thoughts parentheses numbers words lists tabs"),
)  # fmt: skip
def test_an_answer_of_a_model_that_repeats_itself_is_read_at_once(text: str) -> None:
    began = time.process_time()
    parse_names(text)
    assert time.process_time() - began < 2


def test_the_names_at_the_start_of_a_long_answer_are_read() -> None:
    assert parse_names("- chair\n- desk\n" + "\n" * 10**6) == ["chair", "desk"]
    assert parse_names("- chair\n" * 10**5) == ["chair"]
