"""Tables of a run, as Markdown."""

from __future__ import annotations

from .ablations import MONO, OURS, TRUE_POSES, UNFITTED
from .figures import Figures, format_number, tabulate_asked
from .processes import find_function
from .registry import MEASUREMENTS

COLUMNS = (
    "capture", "variant", "ATE cm", "IoU", "mIoU", "precision", "recall", "PSNR dB", "depth cm", "Gaussians",
    "ms/frame", "fps", "memory GB", "map MB", "x dense SLAM", "layer 1 x", "fitting x", "what",
)  # fmt: skip


def write_markdown(results: Figures) -> str:
    """The table of all rows, and those of the measurements. A dash, never a zero, shows what was not measured."""
    lines = [" | ".join(("", *COLUMNS, "")).strip(), "|" + "---|" * len(COLUMNS)]
    for row in results["rows"]:
        cells = (
            row["capture"],
            row["variant"],
            format_number(row.get("ate_rmse_m"), 100, 2),
            *(format_number(row.get(name), 100, 1) for name in ("iou", "miou", "precision", "recall")),
            format_number((row.get("held_out") or {}).get("psnr_measured"), 1, 2),
            format_number((row.get("held_out") or {}).get("depth_l1_m"), 100, 1),
            format_number(row.get("gaussians"), 1, 0),
            format_number(sum(row["ms_per_frame"].values()) if "ms_per_frame" in row else None, 1, 1),
            format_number(row.get("frames_per_second"), 1, 1),
            format_number(row.get("peak_memory_bytes"), 1e-9, 2),
            format_number(row.get("map_bytes"), 1e-6, 1),
            format_number(row.get("wall_over_dense_slam"), 1, 2),
            format_number(row.get("layer_1_over_dense_slam"), 1, 2),
            format_number(row.get("fitting_over_dense_slam"), 1, 2),
            row["title"] if row["available"] else f"{row['title']}: **not available**, {row['why']}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    lines += [f"\nmIoU of {capture}: over {classes}" for capture, classes in _class_lists(results).items()]
    for name, measured in (results.get("measurements") or {}).items():
        lines += _describe_measurement(name, measured)
    return "\n".join(
        [*lines, *_pose_lines(results["rows"]), *_mono_lines(results["rows"]), *_fit_lines(results["rows"])]
    )


def _describe_measurement(name: str, rows: list[Figures]) -> list[str]:
    """A measurement's tables."""
    part = MEASUREMENTS[name]
    if part.table:
        return list(find_function(part.table)(rows))
    lines = []
    for row in rows:
        where = f"{name} of {row['capture']}" if row.get("capture") else name
        if "error" in row:
            lines.append(f"\n{where}: not available, {row['error']}")
        else:
            lines += [f"\n{where}:", *tabulate_asked(find_function(part.lines)(row))]
    return lines


def _pose_lines(rows: list[Figures]) -> list[str]:
    """IoU with estimated poses over IoU with the capture's, where both were measured."""
    iou = {(row["capture"], row["variant"]): row.get("iou") for row in rows}
    lines = []
    for capture in dict.fromkeys(row["capture"] for row in rows):
        ours, given = iou.get((capture, OURS)), iou.get((capture, TRUE_POSES))
        if ours and given:
            lines.append(f"\n{capture}: IoU with our poses is {ours / given:.3f} of that with the capture's poses")
    return lines


def _mono_lines(rows: list[Figures]) -> list[str]:
    """IoU from color alone over IoU with depth, where both were measured."""
    iou = {(row["capture"], row["variant"]): row.get("iou") for row in rows}
    lines = []
    for capture in dict.fromkeys(row["capture"] for row in rows):
        alone, with_depth = iou.get((capture, MONO)), iou.get((capture, OURS))
        if alone and with_depth:
            lines.append(
                f"\n{capture}: IoU from color alone is {alone / with_depth:.3f} of that with depth (0.6 asked)"
            )
    return lines


def _fit_lines(rows: list[Figures]) -> list[str]:
    """What fitting gains on held-out frames and in IoU, and how densely Gaussians lie."""
    found = {(row["capture"], row["variant"]): row for row in rows}
    lines = []
    for capture in dict.fromkeys(row["capture"] for row in rows):
        ours, plain = found.get((capture, OURS), {}), found.get((capture, UNFITTED), {})
        if ours.get("held_out") and plain.get("held_out"):
            was, now = plain["held_out"], ours["held_out"]
            gain, everywhere = (now[name] - was[name] for name in ("psnr_measured", "psnr"))
            iou = 100 * ((ours.get("iou") or 0) - (plain.get("iou") or 0))
            lines.append(
                f"\n{capture}: on {now['frames']} held-out frames fitting changes PSNR by {gain:+.2f} dB where depth "
                f"is measured ({everywhere:+.2f} over all pixels), depth errors from {100 * was['depth_l1_m']:.1f} to "
                f"{100 * now['depth_l1_m']:.1f} cm, and IoU by {iou:+.2f}"
            )
        surface = found.get((capture, "true_poses_tsdf"), {}).get("surface_m2")
        if surface and ours.get("gaussians"):
            lines.append(f"\n{capture}: {ours['gaussians'] / surface:.0f} Gaussians per square meter of surface")
    return lines


def _class_lists(results: Figures) -> dict[str, str]:
    lists = {row["capture"]: row["classes_in_miou"] for row in results["rows"] if row.get("classes_in_miou")}
    return {capture: f"{len(names)} classes: {', '.join(names)}" for capture, names in lists.items()}
