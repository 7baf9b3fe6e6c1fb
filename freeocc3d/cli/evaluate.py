"""``freeocc3d evaluate``: scores maps, or the results of other systems."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ..core.atomic_files import refuse_existing
from .console import Json, Overwrite, Set, show, show_document
from .option_groups import grouped


@dataclass(frozen=True)
class Scored:
    """What is scored: maps, or one result of another system."""

    maps: Annotated[
        list[Path] | None, typer.Argument(metavar="MAP", help="Map folders; all their voxels count together.")
    ] = None
    gaussians: Annotated[
        Path | None, typer.Option("--gaussians", metavar="PLY", help="Gaussians of another system, a 3DGS PLY file.")
    ] = None
    grid: Annotated[Path | None, typer.Option("--grid", metavar="NPZ", help="A finished voxel grid.")] = None
    frames: Annotated[
        Path | None,
        typer.Option("--frames", metavar="FOLDER", help="Gaussians of single frames; true poses join them."),
    ] = None
    trajectory: Annotated[
        Path | None,
        typer.Option("--trajectory", metavar="TXT", help="Trajectory of --gaussians or --grid, a TUM file."),
    ] = None


@dataclass(frozen=True)
class Truth:
    """The truth that it is compared with."""

    ground_truth: Annotated[
        list[Path] | None,
        typer.Option(
            "--ground-truth",
            metavar="GT",
            help="ground_truth.npz, a package's <scene>.pkl, or a folder of packages; repeat it for each map.",
            show_default="the capture's own",
        ),
    ] = None
    poses: Annotated[
        list[str] | None,
        typer.Option(
            "--poses",
            metavar="FILE|CAPTURE",
            help="True poses; repeat it for each map.",
            show_default="the poses of the capture that the map was made from",
        ),
    ] = None


@dataclass(frozen=True)
class Rules:
    """How it is compared."""

    align: Annotated[
        str | None,
        typer.Option(
            "--align",
            metavar="se3|sim3|none",
            help="How trajectories are aligned.",
            show_default="se3; sim3 for maps of unknown scale",
        ),
    ] = None
    classes: Annotated[
        Path | None, typer.Option("--classes", metavar="FILE|NAME", help="File that lists the classes to score.")
    ] = None
    split: Annotated[
        Path | None, typer.Option("--split", metavar="FILE", help="File that lists the scenes to score.")
    ] = None
    overrides: Set = None


@dataclass(frozen=True)
class Report:
    """What comes out."""

    as_json: Json = False
    html: Annotated[
        Path | None, typer.Option("--html", metavar="OUT.html", help="Write a page with figures and pictures.")
    ] = None
    overwrite: Overwrite = False


@grouped
def evaluate(scored: Scored, truth: Truth, rules: Rules, report: Report) -> None:
    """Score maps, or the results of other systems, against the truth."""
    from ..evaluation import scoring
    from .scores import scores_document, scores_lines

    others = (scored.gaussians, scored.grid, scored.frames)
    if sum(path is not None for path in others) + bool(scored.maps) != 1:
        raise typer.BadParameter("give maps, or one of --gaussians, --grid and --frames.")
    if report.html is not None:
        refuse_existing(report.html, report.overwrite)
    asked = scoring.ScoringRequest(
        maps=scored.maps or [],
        gaussians=scored.gaussians,
        grid=scored.grid,
        frames=scored.frames,
        trajectory=scored.trajectory,
        ground_truths=truth.ground_truth or [],
        poses=truth.poses or [],
        align=rules.align,
        classes=rules.classes,
        split=rules.split,
        overrides=rules.overrides or [],
    )
    evaluation = scoring.evaluate_scenes(asked)
    if report.html is not None:
        from ..evaluation.report_page import write_report

        write_report(evaluation, report.html, report.overwrite)
    if report.as_json:
        show_document(scores_document(evaluation))
    else:
        show(*scores_lines(evaluation))
