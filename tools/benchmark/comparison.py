"""What changed between two runs."""

from __future__ import annotations

from .figures import Figures, format_number

COMPARED = {
    "ate_rmse_m": ("ATE cm", 100, 0.05),
    "iou": ("IoU", 100, 0.1),
    "miou": ("mIoU", 100, 0.1),
    "precision": ("precision", 100, 0.1),
    "recall": ("recall", 100, 0.1),
    "wall_over_dense_slam": ("x dense SLAM", 1, 0.05),
    "layer_1_over_dense_slam": ("layer 1 x dense SLAM", 1, 0.03),
    "frames_per_second": ("fps", 1, 1.0),
    "peak_memory_bytes": ("memory GB", 1e-9, 0.05),
    "map_bytes": ("map MB", 1e-6, 0.1),
}
"""Figure -> (name, factor, smallest change that is reported)."""


def describe_moves(old: Figures, new: Figures) -> str:
    """A line for each figure that differs by more than its threshold, and for each row that only one run has."""
    before = {(row["capture"], row["variant"]): row for row in old["rows"]}
    after = {(row["capture"], row["variant"]): row for row in new["rows"]}
    lines = []
    for key, row in after.items():
        where = " ".join(key)
        if key not in before:
            lines.append(f"{where}: new")
            continue
        for name, (title, factor, threshold) in COMPARED.items():
            was, now = before[key].get(name), row.get(name)
            if (was is None) != (now is None):
                lines.append(f"{where}: {title} {format_number(was, factor, 2)} -> {format_number(now, factor, 2)}")
            elif was is not None and now is not None and abs(factor * (now - was)) > threshold:
                lines.append(f"{where}: {title} {factor * was:.2f} -> {factor * now:.2f} ({factor * (now - was):+.2f})")
    lines += [f"{' '.join(key)}: not measured this time" for key in before if key not in after]
    return "\n".join(lines) or "nothing moved"
