"""Warnings as report.json keeps them."""

from freeocc3d.core.warnings import Notice, read_notices


def test_warnings_come_back_and_plain_texts_of_older_maps_are_read() -> None:
    notice = Notice("frames-lost", "Tracking lost 3 frames.")
    assert read_notices([notice.to_dict(), "an older text"]) == [notice, Notice("uncoded", "an older text")]
