"""Warnings as report.json keeps them."""

import json

from freeocc3d.core.typed_documents import parse_json
from freeocc3d.core.warnings import Notice, read_notices


def test_warnings_come_back_and_plain_texts_of_older_maps_are_read() -> None:
    notice = Notice("frames-lost", "Tracking lost 3 frames.")
    assert read_notices([notice.to_dict(), "an older text"]) == [notice, Notice("uncoded", "an older text")]


def test_a_warning_that_names_a_file_whose_name_is_no_text_can_be_read_back() -> None:
    stored = parse_json(json.dumps(Notice("images-left-out", "caf\udce9\n.png is left out.").to_dict()))
    assert read_notices([stored])[0].text == "caf\\udce9\\n.png is left out."
