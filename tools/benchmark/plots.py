"""Pictures of the benchmark: trajectories from above, IoU by capture and variant, time by stage. PNG or SVG by suffix;
the same figures give the same file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = dict[str, Any]

COLORS = ("#77aadd", "#ee8866", "#44bb99", "#eedd88", "#ffaabb", "#99ddff", "#bbcc33", "#aaaa00", "#dddddd")
"""Paul Tol's "light" scheme: color-blind readers can distinguish the colors, and black text is readable on each."""

HATCHES = ("", "///", "...", "xxx")
"""Distinguish names after all colors have been used."""

STYLE: Any = {
    "font.size": 11.0,
    "axes.titlesize": 12.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "freeocc3d",
    "svg.fonttype": "none",
}
DOTS_PER_INCH = 150
LEGEND_COLUMNS = 4


def trajectory_plot(
    path: Path,
    title: str,
    true_xyz: NDArray[np.floating],
    estimated_xyz: NDArray[np.floating],
    errors_m: NDArray[np.floating],
    up: ArrayLike,
) -> None:
    """A trajectory from above, colored by its error.

    true_xyz: (N, 3) true camera centers, meters.  estimated_xyz: (M, 3) estimated ones, aligned to the true frame.
    errors_m: (M,) distance of each from its true one.  up: (3,) the direction toward the ceiling in the true frame.
    """
    import matplotlib

    right, forward = seen_from_above(np.asarray(up, np.float64))
    true, estimated = (np.stack((p @ right, p @ forward), axis=1) for p in (true_xyz, estimated_xyz))
    corner = np.concatenate((true, estimated)).min(axis=0)
    true, estimated = true - corner, estimated - corner
    with matplotlib.rc_context(STYLE):
        width, height = np.ptp(np.concatenate((true, estimated)), axis=0)
        aspect = float(np.clip(height / max(width, 1e-6), 0.35, 1.3))
        figure, axes = _figure(7.5, 1.4 + 5.5 * aspect)
        axes.plot(*true.T, color="0.6", linewidth=1.0, label="true path", zorder=1)
        drawn = axes.scatter(
            estimated[:, 0],
            estimated[:, 1],
            c=100 * np.asarray(errors_m),
            s=9,
            linewidths=0,
            cmap="viridis_r",
            vmin=0,
            vmax=max(100 * float(np.max(errors_m, initial=0)), 0.1),
            zorder=2,
            label="estimated",
        )
        if len(true):
            axes.plot(
                *true[0], marker="o", markersize=8, markerfacecolor="none", color="0.2", linestyle="", label="start"
            )
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(title=title, xlabel="meters", ylabel="meters")
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
        figure.colorbar(drawn, ax=axes, label="error (cm)", fraction=0.05)
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
        _save(figure, path)


def seen_from_above(up: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors (3,) to the right and upwards in a picture that looks down along ``-up``: right x forward = up."""
    up = up / np.linalg.norm(up)
    axis = np.eye(3)[np.argmin(np.abs(up))]  # the most horizontal axis, made horizontal, points right
    right = axis - (axis @ up) * up
    right /= np.linalg.norm(right)
    return right, np.cross(up, right)


def iou_bars(path: Path, rows: Sequence[Row]) -> None:
    """IoU of each variant, grouped by capture in the order of the rows.

    rows: {"capture": name, "variant": name, "iou": fraction 0…1}. If the IoU is None or missing, the plot shows the
    words "not available" instead of a bar.
    """
    import matplotlib

    captures = list(dict.fromkeys(row["capture"] for row in rows))
    looks = _looks(row["variant"] for row in rows)
    ticks: list[tuple[float, str]] = []
    y = 0.0
    with matplotlib.rc_context(STYLE):
        figure, axes = _figure(8.0, 1.2 + 0.32 * len(rows) + 0.45 * len(captures))
        for capture in captures:
            axes.text(0, y, capture, fontweight="bold", va="center", ha="left")
            y += 1
            for row in rows:
                if row["capture"] != capture:
                    continue
                ticks.append((y, row["variant"]))
                if row.get("iou") is None:
                    axes.text(0.7, y, "not available", va="center", ha="left", color="0.45", style="italic")
                else:
                    percent = 100 * row["iou"]
                    axes.barh(y, percent, height=0.8, **looks[row["variant"]])
                    axes.text(percent + 0.7, y, f"{percent:.1f}", va="center", ha="left")
                y += 1
            y += 0.4
        axes.set_yticks([at for at, _ in ticks], [name for _, name in ticks])
        axes.set_xticks(range(0, 101, 20))
        axes.set(xlim=(0, 107), ylim=(y - 0.4, -0.7), xlabel="IoU (%)")
        axes.xaxis.grid(color="0.9")
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
        _save(figure, path)


def stage_bars(path: Path, rows: Sequence[Row]) -> None:
    """Milliseconds a frame of each stage, stacked, a bar for each row that states them.

    rows: {"capture": name, "variant": name, "ms_per_frame": {stage: ms}}. A row without "ms_per_frame", or with None,
    is left out.
    """
    import matplotlib

    timed = [row for row in rows if row.get("ms_per_frame")]
    looks = _looks(stage for row in timed for stage in row["ms_per_frame"])
    longest = max((sum(row["ms_per_frame"].values()) for row in timed), default=1.0)
    with matplotlib.rc_context(STYLE):
        figure, axes = _figure(9.0, 1.2 + 0.42 * len(timed) + 0.25 * math.ceil(len(looks) / LEGEND_COLUMNS))
        for y, row in enumerate(timed):
            left = 0.0
            for stage, ms in row["ms_per_frame"].items():
                axes.barh(y, ms, left=left, height=0.7, **looks[stage])
                if ms > 0.06 * longest:
                    axes.text(left + ms / 2, y, f"{ms:.0f}", va="center", ha="center", fontsize=9)
                left += ms
            axes.text(left + 0.01 * longest, y, f"{left:.0f}", va="center", ha="left")
        axes.set_yticks(range(len(timed)), [f"{row['capture']}, {row['variant']}" for row in timed])
        axes.set(xlim=(0, 1.1 * longest), ylim=(len(timed) - 0.4, -0.6), xlabel="milliseconds a frame")
        axes.xaxis.grid(color="0.9")
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
        for stage, look in looks.items():
            axes.barh(0, 0, label=stage, **look)
        if looks:
            figure.legend(loc="outside lower center", ncols=LEGEND_COLUMNS, frameon=False)
        _save(figure, path)


def _looks(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The look of each name's bar, in the order of the names."""
    return {
        name: {
            "color": COLORS[n % len(COLORS)],
            "hatch": HATCHES[n // len(COLORS) % len(HATCHES)],
            "edgecolor": "white",
            "linewidth": 0.5,
        }
        for n, name in enumerate(dict.fromkeys(names))
    }


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    """An empty figure, size in inches, that draws without a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _save(figure: Figure, path: Path) -> None:
    metadata = {"Date": None} if path.suffix == ".svg" else {}
    figure.savefig(path, dpi=DOTS_PER_INCH, metadata=metadata)
