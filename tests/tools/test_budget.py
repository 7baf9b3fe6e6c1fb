"""The budget states shares of a run and its distance from decoding."""

from benchmark import budget


def test_lines_are_ratios_beside_what_is_asked() -> None:
    row = {
        "frames": 100,
        "keyframes": 10,
        "wall_seconds": 8.0,
        "processor_seconds": 12.0,
        "peak_memory_bytes": 1.1e9,
        "seconds": {"tracking": 4.0, "fitting": 1.0},
        "decoding_seconds": 2.0,
    }
    lines = budget.budget_lines({"cores": 2, "runs": {"every frame": row}})
    found = {what.partition(": ")[2]: (measured, asked) for what, measured, asked in lines}
    assert found["frames a second"] == ("12.5", "25")
    assert found["over decoding alone (2.0 s)"] == ("4.0", "–")
    assert found["processors at work"] == ("1.50", "2")
    assert found["fitting's share"] == ("0.20", "≤ 0.33")
    assert found["peak memory, GB"] == ("1.10", "≤ 1.2")
    assert found["stages"][0] == "tracking 80 %, fitting 20 %"
