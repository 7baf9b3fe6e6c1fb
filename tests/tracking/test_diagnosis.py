"""Why a scan gives no poses: each reason at its border."""

from __future__ import annotations

import re

import pytest

from freeocc3d.core.errors import TrackingError
from freeocc3d.tracking.sfm import diagnosis


class Database:
    """Pairs of images with the kind of their geometry, inliers, and how far they moved in pixels."""

    def __init__(self, pairs: list[tuple[str, int, float]], width: int = 640, images: int = 9) -> None:
        self.pairs, self.width, self.images = pairs, width, images

    def geometries(self) -> list[tuple[int, int, str, int]]:
        return [(n, n + 1, kind, inliers) for n, (kind, inliers, _) in enumerate(self.pairs)]

    def displacement(self, i: int, j: int) -> float:
        assert j == i + 1
        return self.pairs[i][2]

    def size(self) -> tuple[int, int]:
        return self.width, 480

    def frames(self) -> list[int]:
        return list(range(self.images))


def refused(check, *arguments) -> str:
    with pytest.raises(TrackingError) as error:
        check(*arguments)
    return str(error.value)


def test_a_scan_needs_five_images() -> None:
    diagnosis.check_count(5, "scan")
    assert "has 4 usable images, but" in refused(diagnosis.check_count, 4, "scan")
    assert "has 1 usable image, but" in refused(diagnosis.check_count, 1, "scan")


def test_half_of_the_images_need_forty_features() -> None:
    diagnosis.check_features([0, 0, 40, 900, 900], "scan")
    assert "no more than 39 features" in refused(diagnosis.check_features, [39, 0, 39, 900, 900], "scan")


def test_three_pairs_must_match_and_the_camera_must_move() -> None:
    moved = ("CALIBRATED", 50, 3.0)
    nothing = ("CALIBRATED", 0, 3.0)
    diagnosis.check_motion(Database([moved, nothing, moved, moved]), "scan")  # type: ignore[arg-type]
    said = refused(diagnosis.check_motion, Database([moved, nothing, moved]), "scan")
    assert "only 2 pairs of 9 images match. Film slowly" in said
    for width, still, enough in ((640, 0.99, 1.01), (320, 0.99, 1.01), (1920, 2.9, 3.1)):
        pairs = [("CALIBRATED", 50, 0.1)] * 250
        pairs[2] = ("CALIBRATED", 50, enough)  # every second pair is looked at
        diagnosis.check_motion(Database(pairs, width), "scan")  # type: ignore[arg-type]
        pairs[2] = ("CALIBRATED", 50, still)
        said = refused(diagnosis.check_motion, Database(pairs, width), "scan")
        assert re.search(rf"by no more than {still:.1f} pixels", said)


@pytest.mark.parametrize("kind", ["PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC"])
def test_a_camera_that_only_turns_is_told_apart_from_images_without_poses(kind: str) -> None:
    flat, deep, none = (kind, 50, 1.0), ("CALIBRATED", 50, 1.0), (kind, 0, 1.0)
    said = diagnosis.explain_missing_model(Database([flat, flat, deep]), 4, "scan")  # type: ignore[arg-type]
    assert "67% of its image pairs give no depth" in str(said)
    said = diagnosis.explain_missing_model(Database([flat, deep, none, none]), 4, "scan")  # type: ignore[arg-type]
    assert "Of the 9 images of scan, only 4 got a pose" in str(said)
