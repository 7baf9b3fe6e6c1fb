"""The ``freeocc3d`` command: parses, calls Python, prints. Heavy imports happen inside the commands."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from . import __version__
from .errors import ConfigError, FreeOccError, ModelError
from .files import refuse_existing
from .progress import Progress

app = typer.Typer(
    help="A captured indoor scan in, an occupancy map that answers words out: no training, no given poses.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

MapPath = Annotated[Path, typer.Argument(metavar="MAP", help="Map folder.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
_DEVICES = ("tracking", "backend"), ("fitting", "rasterizer")
"""What may have an option ``device``."""

_SHOWN_NAMES = 12

Set = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Set one option; repeatable.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what exists.")]


class ConsoleProgress(Progress):
    """Progress on stderr: one line that is redrawn on a terminal, a line per stage and warning elsewhere."""

    def __init__(self) -> None:
        self._name, self._total, self._start, self._drawn = "", None, 0.0, 0.0  # type: tuple[str, int | None, float, float]
        self._on_terminal = sys.stderr.isatty()

    def stage(self, name: str, total: int | None = None) -> None:
        self.close()
        self._name, self._total, self._start = name, total, time.monotonic()
        if self._on_terminal:
            self._draw(0)

    def advance(self, done: int) -> None:
        if self._on_terminal and (done == self._total or time.monotonic() - self._drawn > 0.1):
            self._draw(done)

    def warn(self, text: str) -> None:
        self._clear()
        print(f"warning: {text}", file=sys.stderr)

    def close(self) -> None:
        """End the present stage's line."""
        if self._name:
            self._clear()
            seconds = time.monotonic() - self._start
            steps = f", {self._total} frames" if self._total else ""
            print(f"{self._name}: {seconds:.1f} s{steps}", file=sys.stderr)
        self._name = ""

    def _draw(self, done: int) -> None:
        self._drawn = time.monotonic()
        line = self._name
        if self._total:
            filled = 30 * done // self._total
            elapsed = self._drawn - self._start
            left = elapsed / done * (self._total - done) if done else 0.0
            line += f" [{'=' * filled}{' ' * (30 - filled)}] {done}/{self._total}, {left:.0f} s left"
        print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)

    def _clear(self) -> None:
        if self._on_terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


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
    config_file: Annotated[Path | None, typer.Option("--config", help="YAML file with options.")] = None,
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
    from . import config, pipeline

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
        made = pipeline.reconstruct(capture, output, settings, overwrite=overwrite, resume=resume, progress=progress)
    finally:
        progress.close()
    print(_info_text(_info(made)))


@app.command()
def query(
    map_path: MapPath,
    words: Annotated[
        list[str] | None, typer.Argument(metavar="WORD...", help="Words or quoted phrases.", show_default=False)
    ] = None,
    as_json: Json = False,
    interactive: Annotated[
        bool,
        typer.Option(
            "--interactive", help="Keep the map loaded and answer each line of the input, phrases separated by commas."
        ),
    ] = False,
    top: Annotated[int | None, typer.Option("--top", metavar="K", help="At most K regions a word.")] = None,
    threshold: Annotated[float | None, typer.Option("--threshold", help="Least score, 0…1.")] = None,
    scores: Annotated[str | None, typer.Option("--scores", help="cosine, softmax or relevancy.")] = None,
    ply: Annotated[Path | None, typer.Option("--ply", help="Write the map as PLY, matches coloured.")] = None,
    picture: Annotated[Path | None, typer.Option("--picture", help="Write a picture, matches coloured (PNG).")] = None,
    html: Annotated[
        Path | None, typer.Option("--html", help="Write one page: regions, the map, and what the camera saw of them.")
    ] = None,
    class_names: Annotated[
        list[str] | None,
        typer.Option("--class", metavar="NAME", help="All voxels of a class of the map's vocabulary; repeatable."),
    ] = None,
    list_classes: Annotated[bool, typer.Option("--classes", help="List the map's vocabulary, and do no more.")] = False,
    image: Annotated[
        Path | None, typer.Option("--image", help="Look for what a picture shows, where the map's encoder can.")
    ] = None,
    image_box: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option("--box", metavar="X0 Y0 X1 Y1", help="With --image: only these pixels of it, the last included."),
    ] = None,
    negative: Annotated[
        list[str] | None, typer.Option("--not", metavar="WORD", help="What is not meant; repeatable.")
    ] = None,
    within: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option("--within", metavar="X0 Y0 Z0 X1 Y1 Z1", help="Regions whose centroid is in a box, map frame."),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option("--near", metavar="WORD[:METRES]", help="Regions with a gap to WORD of at most METRES [0.5]."),
    ] = None,
    on: Annotated[str | None, typer.Option("--on", metavar="WORD", help="Regions that stand on WORD.")] = None,
    pick: Annotated[str | None, typer.Option("--pick", help="Only the largest, highest, lowest or best.")] = None,
    views: Annotated[
        bool, typer.Option("--views", help="With --json: also the keyframes that show each region, and where to stand.")
    ] = False,
    refine_to: Annotated[
        float | None,
        typer.Option("--refine", metavar="METRES", help="Look again with finer voxels, around the best match."),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Keep the map that --refine makes.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Ask a map where something is.

    score, by which regions are ranked, 0…1: how well the voxels fit the word, as if a litre that does not fit belonged
    to the region. conf., 0…1: how probable the word is beside the other words that the map knows. A region may fit
    badly and still be nothing else. Of a picture (--image) the confidence is the mean likeness.
    """
    import tempfile

    from .relations import Where, near_word
    from .store import load_map

    words, class_names = words or [], class_names or []
    questions = len(words) + len(class_names) + (image is not None)
    if list_classes:
        print("\n".join(load_map(map_path).vocabulary))
        return
    if interactive == bool(questions):
        raise typer.BadParameter("give words to look for, --class or --image, or --interactive without any.")
    if interactive and (ply or picture or html or refine_to is not None):
        raise typer.BadParameter(
            "--interactive answers in text or JSON: leave out --ply, --picture, --html and --refine."
        )
    if image_box is not None and image is None:
        raise typer.BadParameter("--box is a part of a picture: give --image, too.")
    if negative and questions > len(words):
        raise typer.BadParameter("--not narrows what words mean: leave it out with --class and --image.")
    if output is not None and refine_to is None:
        raise typer.BadParameter("-o keeps the map that --refine makes: give --refine METRES.")
    if views and not as_json:
        raise typer.BadParameter("--views adds to the document of --json: give both.")
    if refine_to is not None and questions > 1:
        raise typer.BadParameter("--refine looks around the best match of one word.")
    for target in (ply, picture, html):
        if target is not None:
            refuse_existing(target, overwrite)
    options: dict[str, Any] = {}
    if top is not None:
        options["top_k"] = top
    if threshold is not None:
        options["threshold"] = threshold
    if scores is not None:
        options["scores"] = scores
    if any(condition is not None for condition in (within, near, on, pick)):
        word, metres = (None, Where.near_m) if near is None else near_word(near)
        options["where"] = Where(within, word, metres, on, pick)
    loaded = load_map(map_path)
    if interactive:
        _answer_lines(loaded, {**options, "negative": negative or []}, as_json, views)
        return

    def ask(scan_map: Any) -> list[Any]:
        results = scan_map.query_words(words, negative=negative or [], **options) if words else []
        results += scan_map.query_classes(class_names, **options) if class_names else []
        return results if image is None else [*results, scan_map.query_image(image, image_box, **options)]

    results = ask(loaded)
    with tempfile.TemporaryDirectory() as folder:  # for a map that nobody keeps
        if refine_to is not None and results[0].matched:
            loaded = _refined(loaded, results[0].regions[0], refine_to, output or Path(folder) / "refined", overwrite)
            results = ask(loaded)
        if ply is not None:
            from .export.ply import write_query_ply

            write_query_ply(loaded.occupancy, results, ply, overwrite)
        if picture is not None:
            from .viewer import pictures

            pictures.query_picture(loaded, results, picture, overwrite)
        if html is not None:
            from .viewer.page import query_page

            query_page(loaded, results, html, overwrite)
        print(_answer(map_path, loaded, results, as_json, views))


def _answer(map_path: Path, loaded: Any, results: list[Any], as_json: bool, views: bool) -> str:
    from . import query as asking

    if not as_json:
        unit = "" if loaded.metric else "\nLengths are not metres: the map's scale is unknown (freeocc3d scale)."
        return asking.to_text(results) + unit
    from .details import details

    return json.dumps(asking.to_json(map_path, results, details(loaded, results, views), loaded.metric))


def _answer_lines(loaded: Any, options: dict[str, Any], as_json: bool, views: bool) -> None:
    """Answer each line of the standard input until it ends. A line that cannot be answered is told why, in JSON by a
    document with "error" in place of "results", so that every line that is not empty has its document."""
    while True:
        if sys.stdin.isatty():
            print("> ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            return
        words = [word.strip() for word in line.split(",") if word.strip()]
        if not words:
            continue
        try:
            results = loaded.query_words(words, **options)
            print(_answer(loaded.path, loaded, results, as_json, views), flush=True)
        except FreeOccError as error:
            said = " ".join(str(error).split())
            if as_json:
                print(json.dumps({"version": __version__, "map": str(loaded.path), "error": said}), flush=True)
            else:
                print(f"freeocc3d: {said}", file=sys.stderr, flush=True)


def _refined(loaded: Any, region: Any, voxel_size: float, output: Path, overwrite: bool) -> Any:
    from . import refine as refining

    progress = ConsoleProgress()
    box = refining.around(region, loaded.manifest["voxel_size_m"])
    try:
        return refining.refine(loaded, box, voxel_size, output, overwrite=overwrite, progress=progress)
    finally:
        progress.close()


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

    from . import adaptive
    from . import refine as refining
    from .store import load_map

    progress = ConsoleProgress()
    try:
        scan_map = load_map(map_path)
        if box is None:
            made = adaptive.refine_where_needed(scan_map, voxel, output, overwrite=overwrite, progress=progress)
        else:
            corners = refining.Box(np.array(box[:3]), np.array(box[3:]))
            made = refining.refine(scan_map, corners, voxel, output, overwrite=overwrite, progress=progress)
    finally:
        progress.close()
    print(_info_text(_info(made)))


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
    from . import scale as scaling
    from .store import load_map

    if [factor, length, camera_height, poses].count(None) != 3:
        raise typer.BadParameter("give one of --factor, --length, --camera-height and --poses.")
    loaded = load_map(map_path)
    by = "given"
    if length is not None:
        factor, by = scaling.by_length(loaded, length[:2], length[2]), "length"
    elif camera_height is not None:
        factor, by = scaling.by_camera_height(loaded, camera_height), "camera height"
    elif poses is not None:
        factor, by = scaling.by_poses(loaded, poses), "poses"
    assert factor is not None
    print(_info_text(_info(scaling.scaled(loaded, factor, by, output, overwrite=overwrite))))


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
    from . import registry
    from .export import export_map
    from .store import load_map

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
    classes: Annotated[Path | None, typer.Option("--classes", metavar="FILE", help="Classes to score.")] = None,
    split: Annotated[
        Path | None, typer.Option("--split", metavar="FILE", help="Score the scenes that this file lists.")
    ] = None,
    overrides: Set = None,
    html: Annotated[Path | None, typer.Option("--html", metavar="OUT", help="Write a report page.")] = None,
    as_json: Json = False,
    overwrite: Overwrite = False,
) -> None:
    """Score maps, or what other systems made, against the truth."""
    from .evaluation import evaluate as scoring

    others = {"--gaussians": gaussians, "--grid": grid, "--frames": frames}
    named = [f"{option} {path}" for option, path in others.items() if path is not None]
    if len(named) + bool(maps) != 1:
        raise typer.BadParameter("give maps, or one of --gaussians, --grid and --frames.")
    if html is not None:
        refuse_existing(html, overwrite)
    asked = scoring.Asked(
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
    result = scoring.evaluate(asked)
    if html is not None:
        from .evaluation.report import write_report

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
    from .evaluation import replicaocc
    from .evaluation.ground_truth import save_ground_truth

    if protocol != "replicaocc":
        raise typer.BadParameter(f"'{protocol}' is not a protocol; there is replicaocc.", param_hint="--protocol")
    refuse_existing(output, overwrite)
    progress = ConsoleProgress()
    try:
        truth = replicaocc.build(capture, overrides or [], progress)
    finally:
        progress.close()
    save_ground_truth(truth, output, overwrite)
    print(replicaocc.to_text(truth, output))


@app.command()
def view(
    map_path: MapPath,
    picture: Annotated[Path, typer.Option("--picture", help="PNG file to write.")],
    word: Annotated[str | None, typer.Option("--query", metavar="WORD", help="Show what matches a word.")] = None,
    by: Annotated[str, typer.Option("--by", help="Colour by rgb, class or height.")] = "rgb",
    overwrite: Overwrite = False,
) -> None:
    """Draw a map from above and from a corner."""
    from .store import load_map
    from .viewer import pictures

    loaded = load_map(map_path)
    if word is None:
        pictures.map_picture(loaded, picture, by, overwrite)
    else:
        pictures.query_picture(loaded, loaded.query_words([word]), picture, overwrite)
    print(picture)


@app.command()
def info(map_path: MapPath, as_json: Json = False) -> None:
    """Say what is in a map and how it was made."""
    from .store import load_map

    facts = _info(load_map(map_path))
    print(json.dumps(facts) if as_json else _info_text(facts))


@app.command("list")
def list_backends(
    kind: Annotated[
        str | None,
        typer.Argument(metavar="[KIND]", help="Only these: readers, trackers, rasterizers, encoders, exporters."),
    ] = None,
    as_json: Json = False,
    as_yaml: Annotated[bool, typer.Option("--yaml", help="Print a configuration with every key, commented.")] = False,
) -> None:
    """List readers, trackers, encoders and exporters with their options."""
    from . import config, registry

    if as_yaml:
        print(config.documented(), end="")
        return

    folders = registry.FOLDERS if kind is None else [registry.folder_of(kind)]
    found = {registry.FOLDERS[folder]: registry.backends(folder) for folder in folders}
    if as_json:
        print(
            json.dumps(
                {
                    title: {
                        b.name: {
                            "summary": b.summary,
                            "missing": b.missing,
                            "options": {
                                o.name: {"type": o.type, "default": o.default, "doc": o.doc} for o in b.options
                            },
                        }
                        for b in backends.values()
                    }
                    for title, backends in found.items()
                }
            )
        )
        return
    for title, backends in found.items():
        print(f"{title}s")
        for backend in backends.values():
            missing = f"  [needs {', '.join(backend.missing)}]" if backend.missing else ""
            print(f"  {backend.name:<14} {backend.summary}{missing}")
            for option in backend.options:
                print(f"      {option.name} = {option.default!r}  ({option.type}) {option.doc}")


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the map and the pictures.")] = Path("demo"),
    overwrite: Overwrite = False,
) -> None:
    """Build and map the built-in room, ask it three words, write pictures."""
    from . import pipeline
    from . import query as asking
    from .viewer import pictures

    progress = ConsoleProgress()
    try:
        made = pipeline.reconstruct("builtin:room", output / "map", overwrite=overwrite, progress=progress)
    finally:
        progress.close()
    print(_info_text(_info(made)))
    written = [output / "map.png"]
    pictures.map_picture(made, written[0], overwrite=overwrite)
    results = made.query_words(["red cup", "blue chair", "green plant"], top_k=5)
    print(asking.to_text(results))
    for result in results:
        written.append(output / f"query_{result.word.replace(' ', '_')}.png")
        pictures.query_picture(made, [result], written[-1], overwrite)
    print("pictures: " + ", ".join(str(path) for path in written))


models_app = typer.Typer(help="Fetch, list and verify the networks that encoders are made of.", no_args_is_help=True)
app.add_typer(models_app, name="models")


@models_app.command("pull")
def models_pull(
    name: Annotated[
        str, typer.Argument(metavar="NAME|REPO", help="OWNER/NAME on the Hugging Face hub, or a short one.")
    ],
    revision: Annotated[str, typer.Option("--revision", help="Branch, tag or commit.")] = "main",
) -> None:
    """Fetch a model package, or a checkpoint to export, from the Hugging Face hub."""
    from .language import hub

    progress = ConsoleProgress()
    try:
        folder = hub.pull(name, revision, progress)
    finally:
        progress.close()
    if folder.parent.name == hub.CHECKPOINTS:
        print(f"{folder}: a checkpoint, to be exported: python tools/export_encoder.py {folder} -o {folder.name}")
    else:
        print(folder)


@models_app.command("list")
def models_list(as_json: Json = False) -> None:
    """List the models in the models folder."""
    from .language import models

    found = models.installed()
    if as_json:
        facts = {
            name: {"error": str(p)}
            if isinstance(p, FreeOccError)
            else {"kind": p.kind, "dimension": p.dimension, "precision": p.precision, "bytes": p.bytes,
                  "licence": p.licence, "source": p.source}
            for name, p in found.items()
        }  # fmt: skip
        print(json.dumps({"folder": str(models.models_folder()), "models": facts}))
        return
    for name, package in found.items():
        if isinstance(package, FreeOccError):
            print(f"{name:<24} unusable: {package}")
        else:
            print(
                f"{name:<24} {package.kind:<9} {package.dimension:>5} dimensions  {package.precision}  "
                f"{package.bytes / 1e6:8.1f} MB  licence {package.licence}, from {package.source}"
            )
    if not found:
        print(f"There are no models in {models.models_folder()}.")


@models_app.command("verify")
def models_verify(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME|FOLDER]...", help="[default: all]")] = None,
) -> None:
    """Compare the content of every file with the hash in its model's manifest."""
    from .language import models

    folders = [path if (path := Path(name)).is_dir() else models.models_folder() / name for name in names or []]
    damaged = []
    for folder in folders or [models.models_folder() / name for name in models.installed()]:
        try:
            package = models.read(folder)
            models.verify(package)
        except ModelError as error:
            damaged.append(str(error))
        else:
            print(f"{folder}: {len(package.files)} files are as they should be")
    if damaged:
        raise ModelError(" ".join(damaged))


def _info(loaded: Any) -> dict[str, Any]:
    """What ``info --json`` prints."""
    manifest, report = loaded.manifest, loaded.report
    counts = manifest["counts"]
    return {
        "version": manifest["freeocc3d"],
        "map": str(loaded.path),
        "capture": manifest["capture"],
        "frames": counts["frames"],
        "frames_with_pose": counts["frames_with_pose"],
        "frame_status": report["frames"],
        "keyframes": len(manifest["keyframes"]),
        "submaps": counts["submaps"],
        "submap_frames": [
            {key: submap[key] for key in ("first", "last", "frames", "keyframes", "mapped")}
            for submap in report.get("submaps", [])
        ],
        "color_focal": report.get("color_focal", 1.0),
        "gaussians": counts["gaussians"],
        "voxels": {"occupied": counts["voxels"]["occupied"], "free": counts["voxels"]["free"]},
        "metric": loaded.metric,
        "scale": manifest.get("scale", {"metric": True, "by": "sensor", "factor": 1.0}),
        "voxel_size_m": manifest["voxel_size_m"],
        "finest_voxel_m": manifest.get("finest_voxel_m", manifest["voxel_size_m"]),
        "refined": manifest.get("refined"),
        "encoder": manifest["encoder"]["name"],
        "encoder_knows": loaded.text_encoder.knows,
        "vocabulary": manifest.get("vocabulary"),
        "bytes": {
            name: sum(size for file, size in manifest["files"].items() if file.split("/")[0] == name)
            for name in dict.fromkeys(file.split("/")[0] for file in manifest["files"])
        },
        "seconds": report["seconds"],
        "peak_memory_bytes": report["peak_memory_bytes"],
        "warnings": report["warnings"],
    }


def _info_text(facts: dict[str, Any]) -> str:
    size = sum(facts["bytes"].values())
    used = facts["frames"] - facts["frame_status"].get("unused", 0)
    largest, smallest = facts["voxel_size_m"], facts["finest_voxel_m"]
    unit = "m" if facts["metric"] else "units of unknown length"
    plural = {name: "s" if facts[name] != 1 else "" for name in ("keyframes", "submaps")}
    seconds = ", ".join(f"{name} {value:.1f}" for name, value in facts["seconds"].items())
    lines = [
        f"map        {facts['map']}  ({size / 1e6:.1f} MB)",
        f"capture    {facts['capture']['path']}  ({facts['capture']['format']})",
        f"frames     {facts['frames']} in the capture, {used} used, {facts['frames_with_pose']} with a pose, "
        f"{facts['keyframes']} keyframe{plural['keyframes']}, {facts['submaps']} submap{plural['submaps']}",
        *(
            [
                f"refined    {'a box of ' if 'box' in facts['refined'] else 'from '}{facts['refined']['map']}, whose "
                "frames and times these are"
            ]
            if facts["refined"]
            else []
        ),
        f"gaussians  {facts['gaussians']:,}",
        f"voxels     {facts['voxels']['occupied']:,} occupied, {facts['voxels']['free']:,} free, "
        + (f"edge {largest:.3g} {unit}" if largest == smallest else f"edges {largest:.3g} to {smallest:.3g} {unit}"),
        *([] if facts["scale"]["by"] == "sensor" else [_scale_text(facts["scale"])]),
        f"encoder    {facts['encoder']}, which knows {facts['encoder_knows']}",
        *([_vocabulary_text(facts["vocabulary"])] if facts["vocabulary"] else []),
        f"time       {sum(facts['seconds'].values()):.1f} s: {seconds}",
        f"memory     {facts['peak_memory_bytes'] / 1e9:.2f} GB at most",
    ]
    if facts["submaps"] > 1:
        lines += [
            f"submap     frames {submap['first']} to {submap['last']}: {submap['frames']} with a pose, of these "
            f"{submap['keyframes']} as keyframes; {'mapped' if submap['mapped'] else 'apart, not in the map'}"
            for submap in facts["submap_frames"]
        ]
    lines += [f"warning    {text}" for text in facts["warnings"]]
    return "\n".join(lines)


def _scale_text(scale: dict[str, Any]) -> str:
    if not scale["metric"]:
        return "scale      unknown: lengths are not metres"
    told = {"given": "as given", "length": "by a known length", "camera height": "by the cameras' height"}
    times = "" if scale["factor"] == 1 else f", {scale['factor']:.4g} of them per unit of what was tracked"
    return f"scale      metres, {told.get(scale['by'], 'by the poses')}{times}"


def _vocabulary_text(vocabulary: dict[str, Any]) -> str:
    names = vocabulary["names"]
    shown = ", ".join(f"{name} {entry['count']}" for name, entry in list(names.items())[:_SHOWN_NAMES])
    return (
        f"words      {len(names)} named by {vocabulary['model']} in {len(vocabulary['keyframes'])} keyframes"
        + (f": {shown}" if shown else "")
        + (", …" if len(names) > _SHOWN_NAMES else "")
    )


def main(arguments: list[str] | None = None) -> None:
    """Run the command; a known error is one line on stderr and exit code 1, or with --debug its traceback."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    try:
        app(args=[argument for argument in arguments if argument != "--debug"], prog_name="freeocc3d")
    except FreeOccError as error:
        if debug:
            raise
        print(f"freeocc3d: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
