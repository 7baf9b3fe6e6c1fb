"""The ``freeocc3d`` command: parses, calls Python, prints. Heavy imports happen inside the commands."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from .. import __version__
from ..core.atomic_files import refuse_existing
from ..core.errors import ConfigError, FreeOccError
from . import models, summary
from .console import ConsoleProgress, Json, MapPath, Overwrite, Set
from .list_backends import list_backends
from .query import query

app = typer.Typer(
    help="A captured indoor scan in, an occupancy map that answers words out: no training, no given poses.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_DEVICES = ("tracking", "backend"), ("fitting", "rasterizer")
"""What may have an option ``device``."""


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error; also after a command.")
    ] = False,
) -> None:
    if version:
        print(__version__)
        raise typer.Exit


@app.command()
def reconstruct(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Folder of a scan, a video, or builtin:room.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MAP", help="Map folder to write.")],
    config_file: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE|NAME", help="YAML file with options, or a preset: mono, rgbd, …"),
    ] = None,
    overrides: Set = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    overwrite: Overwrite = False,
    device: Annotated[str | None, typer.Option("--device", help="cpu (the default) or cuda:0.")] = None,
    scale: Annotated[
        float | None,
        typer.Option("--scale", metavar="S", help="Metres per unit of the poses, where there is no depth to say it."),
    ] = None,
) -> None:
    """Turn a captured scan into a map."""
    from ..pipeline import run
    from ..settings import config

    settings = config.load(config_file, [*(overrides or []), *([] if scale is None else [f"capture.scale={scale}"])])
    if device is not None:
        chosen = [(section, settings[section][key]) for section, key in _DEVICES]
        movable = [settings[section][name] for section, name in chosen if "device" in settings[section].get(name, {})]
        for options in movable:
            options["device"] = device
        if device != "cpu" and not movable:
            raise ConfigError(
                f"Nothing that is chosen runs on {device}: it needs fitting.rasterizer=gsplat, or "
                "tracking.backend=odometry."
            )
    progress = ConsoleProgress()
    try:
        made = run.reconstruct(capture, output, settings, overwrite=overwrite, resume=resume, progress=progress)
    finally:
        progress.close()
    print(summary.to_text(made))


app.command()(query)


@app.command()
def refine(
    map_path: MapPath,
    voxel: Annotated[float, typer.Option("--voxel", metavar="METRES", help="Edge of the finest voxels.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MAP", help="Map folder to write.")],
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--box",
            metavar="X0 Y0 Z0 X1 Y1 Z1",
            help="Lower and upper corner, map frame, metres: a map of this box alone, all of finer voxels. "
            "[default: the whole map, voxels finer only where they show more]",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a map of another one with finer voxels: in a box, or wherever they show more."""
    import numpy as np

    from ..editing import adaptive_voxels
    from ..editing import box_refinement as refining
    from ..storage.store import load_map

    progress = ConsoleProgress()
    try:
        scan_map = load_map(map_path)
        if box is None:
            made = adaptive_voxels.refine_where_needed(scan_map, voxel, output, overwrite=overwrite, progress=progress)
        else:
            corners = refining.Box(np.array(box[:3]), np.array(box[3:]))
            made = refining.refine_box(scan_map, corners, voxel, output, overwrite=overwrite, progress=progress)
    finally:
        progress.close()
    print(summary.to_text(made))


@app.command()
def scale(
    map_path: MapPath,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MAP", help="Map folder to write.")],
    factor: Annotated[float | None, typer.Option("--factor", metavar="S", help="Metres per unit of the map.")] = None,
    length: Annotated[
        tuple[str, str, float] | None,
        typer.Option(
            "--length",
            metavar="POINT POINT METRES",
            help="How far two points are apart: each a pixel of a keyframe, FRAME:X,Y, or a word.",
        ),
    ] = None,
    camera_height: Annotated[
        float | None, typer.Option("--camera-height", metavar="METRES", help="Of the cameras above the floor.")
    ] = None,
    poses: Annotated[
        str | None, typer.Option("--poses", metavar="FILE|CAPTURE", help="Poses of the same frames in metres.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Give a map whose scale is unknown lengths in metres."""
    from ..editing import scaling
    from ..storage.store import load_map

    if [factor, length, camera_height, poses].count(None) != 3:
        raise typer.BadParameter("give one of --factor, --length, --camera-height and --poses.")
    loaded = load_map(map_path)
    by = "given"
    if length is not None:
        factor, by = scaling.scale_by_length(loaded, length[:2], length[2]), "length"
    elif camera_height is not None:
        factor, by = scaling.scale_by_camera_height(loaded, camera_height), "camera height"
    elif poses is not None:
        factor, by = scaling.scale_by_poses(loaded, poses), "poses"
    assert factor is not None
    print(summary.to_text(scaling.scale_map(loaded, factor, by, output, overwrite=overwrite)))


@app.command()
def export(
    map_path: MapPath,
    format_name: Annotated[str, typer.Option("--format", help="See 'freeocc3d list exporters'.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write.")],
    frame: Annotated[
        str | None, typer.Option("--frame", help="map, gravity (z up, floor at 0) or first-camera (z up, from there).")
    ] = None,
    overrides: Set = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a map in another program's format."""
    from ..export import export_map
    from ..settings import registry
    from ..storage.store import load_map

    known = registry.backend("export", format_name).options
    options = {} if frame is None else {"frame": frame}
    options |= _values(overrides or [], {option.name: option.type for option in known})
    refuse_existing(output, overwrite)
    progress, loaded = ConsoleProgress(), load_map(map_path)
    for note in export_map(loaded, format_name, output, options, overwrite=overwrite):
        progress.warn(note)
    if not loaded.metric:
        print("note: lengths are not metres, for the map's scale is unknown (freeocc3d scale).", file=sys.stderr)
    files = [path for path in output.rglob("*") if path.is_file()] if output.is_dir() else [output]
    print(f"{output}: {sum(path.stat().st_size for path in files):,} bytes")


def _values(overrides: list[str], types: dict[str, str]) -> dict[str, Any]:
    """Options from name=value, values being YAML; lists may go without brackets."""
    import yaml

    values = {}
    for override in overrides:
        name, separator, text = (part.strip() for part in override.partition("="))
        if not separator:
            raise ConfigError(f"An option reads name=value, got '{override}'.")
        kind = types.get(name, "")
        bare = [part.strip() for part in text.split(",")] if kind.startswith("tuple[") and text[:1] != "[" else None
        try:
            if bare is None:
                values[name] = yaml.safe_load(text)
            else:
                values[name] = bare if "str" in kind else [yaml.safe_load(part) for part in bare]
        except yaml.YAMLError as error:
            raise ConfigError(f"The value of '{name}' is no YAML: '{text}'.") from error
    return values


@app.command()
def evaluate(
    maps: Annotated[
        list[Path] | None, typer.Argument(metavar="[MAP]...", help="Map folders; pooled by voxels.")
    ] = None,
    ground_truth: Annotated[
        list[Path] | None,
        typer.Option(
            "--ground-truth",
            metavar="GT",
            help="ground_truth.npz, a package's <scene>.pkl, or a folder of packages; one for each map. "
            "[default: the capture's own]",
        ),
    ] = None,
    gaussians: Annotated[
        Path | None, typer.Option("--gaussians", metavar="PLY", help="Score another system's 3DGS PLY.")
    ] = None,
    grid: Annotated[Path | None, typer.Option("--grid", metavar="NPZ", help="Score a finished voxel grid.")] = None,
    frames: Annotated[
        Path | None, typer.Option("--frames", metavar="FOLDER", help="Score per-frame Gaussians, fused by true poses.")
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option("--trajectory", metavar="TXT", help="Trajectory of --gaussians or --grid (TUM).")
    ] = None,
    poses: Annotated[
        list[str] | None,
        typer.Option(
            "--poses",
            metavar="FILE|CAPTURE",
            help="True poses; one for each map. [default: the poses of the capture that the map was made of]",
        ),
    ] = None,
    align: Annotated[
        str | None,
        typer.Option("--align", help="se3, sim3 or none. [default: se3; sim3 for maps of unknown scale]"),
    ] = None,
    classes: Annotated[Path | None, typer.Option("--classes", metavar="FILE|NAME", help="Classes to score.")] = None,
    split: Annotated[
        Path | None, typer.Option("--split", metavar="FILE", help="Score the scenes that this file lists.")
    ] = None,
    overrides: Set = None,
    html: Annotated[Path | None, typer.Option("--html", metavar="OUT", help="Write a report page.")] = None,
    as_json: Json = False,
    overwrite: Overwrite = False,
) -> None:
    """Score maps, or what other systems made, against the truth."""
    from ..evaluation import scoring

    others = {"--gaussians": gaussians, "--grid": grid, "--frames": frames}
    named = [f"{option} {path}" for option, path in others.items() if path is not None]
    if len(named) + bool(maps) != 1:
        raise typer.BadParameter("give maps, or one of --gaussians, --grid and --frames.")
    if html is not None:
        refuse_existing(html, overwrite)
    asked = scoring.ScoringRequest(
        maps=maps or [],
        gaussians=gaussians,
        grid=grid,
        frames=frames,
        trajectory=trajectory,
        ground_truths=ground_truth or [],
        poses=poses or [],
        align=align,
        classes=classes,
        split=split,
        overrides=overrides or [],
    )
    result = scoring.evaluate_scenes(asked)
    if html is not None:
        from ..evaluation.report_page import write_report

        write_report(result, html, overwrite)
    print(json.dumps(result.to_json()) if as_json else result.to_text())


@app.command("ground-truth")
def ground_truth_command(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Folder of a scan with poses, or builtin:room.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="GT.npz", help="File to write.")],
    protocol: Annotated[str, typer.Option("--protocol", help="replicaocc (the only one).")] = "replicaocc",
    overrides: Set = None,
    overwrite: Overwrite = False,
) -> None:
    """Build the true occupancy of a capture from its poses, depth and class images."""
    from ..evaluation import replicaocc_truth
    from ..evaluation.ground_truth import save_ground_truth

    if protocol != "replicaocc":
        raise typer.BadParameter(f"'{protocol}' is not a protocol; there is replicaocc.", param_hint="--protocol")
    refuse_existing(output, overwrite)
    progress = ConsoleProgress()
    try:
        truth = replicaocc_truth.build_truth(capture, overrides or [], progress)
    finally:
        progress.close()
    save_ground_truth(truth, output, overwrite)
    print(replicaocc_truth.describe_truth(truth, output))


@app.command()
def view(
    map_path: MapPath,
    picture: Annotated[Path, typer.Option("--picture", help="PNG file to write.")],
    word: Annotated[str | None, typer.Option("--query", metavar="WORD", help="Show what matches a word.")] = None,
    by: Annotated[str, typer.Option("--by", help="Colour by rgb, class or height.")] = "rgb",
    overwrite: Overwrite = False,
) -> None:
    """Draw a map from above and from a corner."""
    from ..storage.store import load_map
    from ..viewer import map_pictures

    loaded = load_map(map_path)
    if word is None:
        map_pictures.write_map_picture(loaded, picture, by, overwrite)
    else:
        map_pictures.write_query_picture(loaded, loaded.query_words([word]), picture, overwrite)
    print(picture)


@app.command()
def info(map_path: MapPath, as_json: Json = False) -> None:
    """Say what is in a map and how it was made."""
    from ..storage.store import load_map

    loaded = load_map(map_path)
    print(json.dumps(summary.facts(loaded)) if as_json else summary.to_text(loaded))


app.command("list")(list_backends)


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the map and the pictures.")] = Path("demo"),
    overwrite: Overwrite = False,
) -> None:
    """Build and map the built-in room, ask it three words, write pictures."""
    from ..pipeline import run
    from ..query import word_query as asking
    from ..viewer import map_pictures

    progress = ConsoleProgress()
    try:
        made = run.reconstruct("builtin:room", output / "map", overwrite=overwrite, progress=progress)
    finally:
        progress.close()
    print(summary.to_text(made))
    written = [output / "map.png"]
    map_pictures.write_map_picture(made, written[0], overwrite=overwrite)
    results = made.query_words(["red cup", "blue chair", "green plant"], top_k=5)
    print(asking.to_text(results))
    for result in results:
        written.append(output / f"query_{result.word.replace(' ', '_')}.png")
        map_pictures.write_query_picture(made, [result], written[-1], overwrite)
    print("pictures: " + ", ".join(str(path) for path in written))


app.add_typer(models.app, name="models")


def main(arguments: list[str] | None = None) -> None:
    """Run the command; a known error is one line on stderr and exit code 1, or with --debug its traceback."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    for stream, errors in ((sys.stdin, "replace"), (sys.stdout, "backslashreplace")):  # what no terminal shows is told
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=errors)
    try:
        app(args=[argument for argument in arguments if argument != "--debug"], prog_name="freeocc3d")
    except FreeOccError as error:
        if debug:
            raise
        print(f"freeocc3d: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
