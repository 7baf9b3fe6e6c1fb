"""``freeocc3d check``: its lines, its document and its picture."""

import json
from pathlib import Path

import cv2
import numpy as np
from command_line import refused, run

from freeocc3d.viewer.check_picture import SIZE


def test_check_tells_each_measure_with_what_is_usual(room: Path) -> None:
    lines = run("check", room).stdout.splitlines()
    assert lines[0].split() == ["measured", "usual"]
    (step,) = (line for line in lines if line.startswith("depth, from keyframe to keyframe"))
    assert " cm, " in step
    assert step.endswith(("good", "fair", "poor"))
    assert any(line.startswith("depth, at revisits") and line.endswith("not told") for line in lines)
    assert lines[-1].split()[0] == "verdict"


def test_the_document_and_the_picture(room: Path, tmp_path: Path) -> None:
    picture = tmp_path / "where.png"
    document = json.loads(run("check", room, "--json", "--picture", picture).stdout)
    assert document["metric"] is True
    assert document["verdict"] in ("good", "fair", "poor")
    step = document["measures"]["step"]
    assert set(step) == {"value", "unit", "count", "compared", "usual", "verdict"}
    frames = json.loads((room / "keyframes" / "keyframes.json").read_text())
    assert set(document["worst"][0]["frames"]) <= {int(entry["frame"]) for entry in frames}
    drawn = cv2.imread(str(picture))
    assert drawn.shape == (SIZE[1], SIZE[0], 3)
    plan = drawn[60:900, :860].reshape(-1, 3).astype(int)
    assert (np.ptp(plan, axis=1) > 60).mean() > 0.02  # colors of residuals, not only gray
    assert "already exists" in refused("check", room, "--picture", picture)
    assert "not a map" in refused("check", tmp_path)
