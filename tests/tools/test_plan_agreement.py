"""The benchmark's figures of plans for robots, and of exporters, on known cases."""

import numpy as np
import pytest
from benchmark import exports, plan_agreement, report
from benchmark.plan_agreement import FREE, OCCUPIED, UNKNOWN


def test_who_knows_a_cell_decides_over_what_agreement_is() -> None:
    true = np.array([[FREE] * 5 + [OCCUPIED] * 2 + [UNKNOWN]], np.uint8)
    ours = np.array([[FREE, FREE, OCCUPIED, FREE, UNKNOWN, OCCUPIED, FREE, FREE]], np.uint8)
    told = np.array([[FREE] * 4 + [UNKNOWN, OCCUPIED, UNKNOWN, UNKNOWN]], np.uint8)
    found = plan_agreement.agreement(ours, true, told)
    assert found["cells_known_to_truth"] == 7
    assert found["known_to_both"] == pytest.approx(6 / 7)
    assert found["measured"] == pytest.approx(5 / 7)
    assert found["agree_of_both"] == pytest.approx(4 / 6)
    assert found["agree_of_measured"] == pytest.approx(4 / 5)
    assert found["agree_of_truth"] == pytest.approx(4 / 7)
    assert found["free_called_occupied"] == pytest.approx(1 / 5)
    assert found["occupied_called_free"] == pytest.approx(1 / 2)
    assert found["obstacles_invented"] == pytest.approx(1 / 5)
    assert found["obstacles_lost"] == 0  # one of ours is beside
    assert found["free_in_one_piece"] == pytest.approx(2 / 3)  # the obstacle shuts one of three off
    lines = report.write_markdown({"rows": [], "measurements": {"plan": [{"capture": "room", **found}]}})
    assert "called free | 50.0 % | 0 % |" in lines


def test_exports_of_a_map_are_measured_in_processes_of_their_own(tmp_path, monkeypatch) -> None:
    from freeocc3d.pipeline.run import reconstruct

    few = {"capture": {"stride": 40}, "tracking": {"backend": "known"}, "fitting": {"passes": 0}}
    reconstruct("builtin:room", tmp_path / "room", few)
    chosen = {name: exports.EXPORTS[name] for name in (exports.BT, "nav2, with costs of three words")}
    monkeypatch.setattr(exports, "EXPORTS", chosen)
    figures = exports.measure_map_exports(str(tmp_path / "room"))
    for row in figures["exports"].values():
        assert row["seconds"] > 0
        assert row["bytes"] > 500
        assert row["peak_memory_bytes"] > 5e7
    if figures["octomap"]:
        assert figures["octomap"]["same"]
    lines = report.write_markdown({"rows": [], "measurements": {"exports": [{"capture": "room", **figures}]}})
    assert "|   octomap .bt | " in lines
    assert "| 10 s, 2 GB |" in lines


def test_exports_that_were_not_measured_are_reported() -> None:
    lines = report.write_markdown({"rows": [], "measurements": {"exports": [{"capture": "a", "error": "no poses"}]}})
    assert lines.splitlines()[-1] == "exports of a: not available, no poses"
