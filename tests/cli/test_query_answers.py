"""Answers to a query as JSON and as text."""

import json
from pathlib import Path

from worded_voxels import WORDS, box, feature, occupancy

from freeocc3d.cli.query_answers import answers_document, answers_lines
from freeocc3d.query.word_query import query


def test_json_has_the_documented_keys_and_is_json() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(SOFA=1)))
    document = json.loads(json.dumps(answers_document(Path("maps/room"), query(room, WORDS, ["sofa", "unicorn"]))))
    assert document["map"] == "maps/room"
    sofa, unicorn = document["results"]
    documented = {"score", "confidence", "centroid", "box_min", "box_max", "volume_m3", "voxels"}
    assert documented <= set(sofa["regions"][0])
    assert sofa["regions"][0]["box_max"] == [0.2, 0.2, 0.2]
    assert (unicorn["matched"], unicorn["regions"], unicorn["understood"]) == (False, [], "")


def test_text_names_each_word_and_region() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(SOFA=1)))
    text = "\n".join(answers_lines(query(room, WORDS, ["sofa", "unicorn"])))
    assert "sofa: 1 region" in text
    assert "unicorn: no match" in text
