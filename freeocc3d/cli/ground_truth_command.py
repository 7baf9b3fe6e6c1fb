"""``freeocc3d ground-truth``: the true occupancy of a capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core.atomic_files import refuse_existing
from .console import ConsoleProgress, Overwrite, Set, show

if TYPE_CHECKING:
    from ..evaluation.true_occupancy import GroundTruth


def ground_truth(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Folder of a scan with poses, or builtin:room.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="GT.npz", help="File to write.")],
    protocol: Annotated[
        str, typer.Option("--protocol", metavar="NAME", help="Name of the protocol; replicaocc is the only one.")
    ] = "replicaocc",
    overrides: Set = None,
    overwrite: Overwrite = False,
) -> None:
    """Build the true occupancy of a capture from its poses, depth and class images."""
    from ..evaluation import replicaocc_truth
    from ..evaluation.ground_truth import save_ground_truth

    if protocol != "replicaocc":
        raise typer.BadParameter(f"'{protocol}' is not a protocol: use replicaocc.", param_hint="--protocol")
    refuse_existing(output, overwrite)
    with ConsoleProgress() as progress:
        truth = replicaocc_truth.build_truth(capture, overrides or [], progress)
    save_ground_truth(truth, output, overwrite)
    show(*truth_lines(truth, output))


def truth_lines(truth: GroundTruth, path: Path) -> list[str]:
    """A summary for people."""
    import numpy as np

    from ..core.types import FREE, UNKNOWN

    known = truth.labels != UNKNOWN
    occupied = known & (truth.labels != FREE)
    counts = np.bincount(truth.labels[occupied], minlength=len(truth.classes))
    common = ", ".join(f"{truth.classes[k]} {counts[k]:,}" for k in np.argsort(-counts, kind="stable") if counts[k])
    x, y, z = truth.shape
    return [
        f"{path}: {x} x {y} x {z} voxels of {truth.voxel_size:g} m, {int(known.sum()):,} observed, "
        f"{int(occupied.sum()):,} occupied",
        f"classes: {common}",
    ]
