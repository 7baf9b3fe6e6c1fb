"""Extreme and confused values of options: in files, as overrides, for commands, exporters and ground truth."""

from __future__ import annotations

import functools
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import yaml

import freeocc3d
from freeocc3d.evaluation import replicaocc_truth
from freeocc3d.pipeline import checks
from freeocc3d.query import word_query
from freeocc3d.settings import config, registry, stages
from freeocc3d.settings.syntax_trees import options_of
from freeocc3d.settings.typed_options import field_types

from . import mutators
from .harness import Attack, command

SHORT = 60

_TINY: dict[str, Any] = {
    "capture": {"stop": 5, "color_focal": 1, "synthetic": {"frames": 60, "width": 64, "height": 48}},
    "tracking": {"backend": "known"},
    "fitting": {"passes": 1, "width": 64},
}
_LONG = {
    "fitting.passes", "capture.stop", "capture.synthetic.width", "capture.synthetic.height", "fitting.rasterizer",
    "tracking.backend", "vocabulary.endpoint", "language.encoder",
}  # fmt: skip
"""Options of which a larger value is more work, as asked, or needs other programs: checked, but not run."""
_TEXT_NUMBERS = (
    "0", "-1", "1e9", "1e30", "1e-30", "1e308", "-1e308", "nan", "inf", "-inf", "9" * 400, "1e999", "0x10", "1_0", "",
    "x", "0.0001", "0.001", "0.01", "0.1", "0.5", "1", "2", "10", "100", "1000", "1e6", "9223372036854775807",
    "-0.0", " 1", "١",
)  # fmt: skip


def prepare(folder: Path) -> None:
    """A small map, for the commands."""
    freeocc3d.reconstruct("builtin:room", folder / "map", {**_TINY, "occupancy": {"voxel_size": 0.1}})


def attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """One or a few options, or one use of the command line."""
    kind = rng.random()
    if kind < 0.62:
        return _configuration(rng, folder, runs=False)
    if kind < 0.70:
        return _configuration(rng, folder, runs=True)
    return _command(rng, originals / "map", folder)


@functools.cache
def _names() -> tuple[tuple[str, Any], ...]:
    """Name and type of every option of a configuration."""
    found = []
    for name, section in config.SECTIONS.items():
        where = f"{section.within}.{name}" if section.within else name
        for option in options_of(stages.__name__, section.options.__name__):
            found.append((f"{where}.{option.name}", option.kind))
        for backend in registry.backends(section.folder).values() if section.folder else ():
            found += [(f"{where}.{backend.name}.{option.name}", option.kind) for option in backend.options]
    return tuple(found)


def _numbers_in(kind: Any) -> list[tuple[float, float]]:
    """The bounds of the numbers in a type."""
    metas = getattr(kind, "__metadata__", ())
    low = [bound for meta in metas for bound in (meta.gt, meta.ge) if bound is not None]
    high = [bound for meta in metas for bound in (meta.lt, meta.le) if bound is not None]
    own = [(max(low), min(high))] if low and high else []
    return own + [bounds for part in get_args(kind) for bounds in _numbers_in(part)]


def _value(rng: random.Random, kind: Any, within: bool) -> Any:
    """A value for an option: one that its bounds allow, also at them, or anything."""
    bounds = _numbers_in(kind)
    if not within and rng.random() < 0.6:
        return mutators.any_value(rng)
    if not bounds:
        return rng.choice(("cpu", "cuda:0", "cuda:99", "CPU", True, False, None, [], "", "x", ["a"], *_choices(kind)))
    made = [_number(rng, *rng.choice(bounds), within) for _ in range(6)]
    return made[: len(bounds)] if len(bounds) > 1 else made[0]


def _choices(kind: Any) -> tuple[Any, ...]:
    return tuple(choice for part in (kind, *get_args(kind)) for choice in get_args(part) if isinstance(choice, str))


def _number(rng: random.Random, low: float, high: float, within: bool) -> Any:
    least = low if low > 0 else min(1e-6, high)
    spread = least * (high / least) ** rng.random() if high > 0 else low
    edges = [low, high, spread, spread, (low + high) / 2]
    if not within:
        edges += [low - 1, high + 1, high * 10, -high, low / 10]
    value = rng.choice(edges)
    whole = isinstance(low, int) and isinstance(high, int)
    return int(value) if whole and (within or rng.random() < 0.8) else value


def _configuration(rng: random.Random, folder: Path, runs: bool) -> Attack:
    names = [(name, kind) for name, kind in _names() if not (runs and _unfit(name))]
    given = [(name, _value(rng, kind, within=runs)) for name, kind in rng.sample(names, rng.choice((1, 1, 1, 2, 3)))]
    if runs:
        return Attack(f"reconstruct {_shown(given)}", functools.partial(_reconstruct, given, folder / "made"))
    way = rng.randrange(3)
    if way == 0:
        return Attack(f"resolve {_shown(given)}", lambda: _check(config.resolve(_nested(given))))
    if way == 1:
        path = folder / "options.yaml"
        path.write_text(_dumped(_nested(given)), encoding="utf-8", errors="surrogatepass")
        if rng.random() < 0.5:
            what = mutators.change_yaml(rng, path) if path.stat().st_size else ""
            return Attack(f"file {_shown(given)}; {what}", lambda: _check(config.load(path)))
        return Attack(f"file {_shown(given)}", lambda: _check(config.load(path)))
    texts = [f"{name}={rng.choice((_dumped_value(value), str(value)[:5000]))}" for name, value in given]
    if rng.random() < 0.2:
        texts.append(
            rng.choice((*mutators.TEXTS, *mutators.RAW_YAML, f"{given[0][0]}={rng.choice(mutators.RAW_YAML)}"))
        )
    return Attack(f"--set {texts!r:.200}", lambda: _check(config.load(_preset(rng), texts)))


def _preset(rng: random.Random) -> Path | None:
    return rng.choice((None, None, Path("mono"), Path("rgbd"), Path("monno"), Path("\0"), Path("x" * 5000), Path("..")))


def _unfit(name: str) -> bool:
    """Whether a run with another value is long, or does not use the value."""
    other = name.split(".")[:2] not in (["capture", "synthetic"], ["tracking", "known"], ["language", "color"])
    return name in _LONG or (name.count(".") > 1 and other) or name.endswith(("device", "format"))


def _check(settings: config.Settings) -> None:
    config.resolve(yaml.safe_load(config.dump(settings)))
    checks.check(settings)


def _reconstruct(given: list[tuple[str, Any]], target: Path) -> None:
    values = _nested(given, json.loads(json.dumps(_TINY)))
    freeocc3d.reconstruct("builtin:room", target, values)


def _nested(given: list[tuple[str, Any]], values: dict[str, Any] | None = None) -> dict[str, Any]:
    """The options as sections, in those of ``values``."""
    values = {} if values is None else values
    for name, value in given:
        *sections, key = name.split(".")
        node = values
        for section in sections:
            node = node.setdefault(section, {})
        node[key] = value
    return values


def _dumped(values: Any) -> str:
    try:
        return yaml.safe_dump(values)
    except (yaml.YAMLError, ValueError, RecursionError, UnicodeError):
        return "occupancy: {voxel_size: " + "9" * 5000 + "}"


def _dumped_value(value: Any) -> str:
    try:
        return json.dumps(value)[:5000]
    except (ValueError, RecursionError):
        return "9" * 5000


def _shown(given: list[tuple[str, Any]]) -> str:
    texts = []
    for name, value in given:
        try:
            texts.append(f"{name}={value!r:.80}")
        except ValueError:
            texts.append(f"{name}=(thousands of digits)")
    return ", ".join(texts)


def _command(rng: random.Random, scan_map: Path, folder: Path) -> Attack:
    """One command with extreme numbers."""
    number = lambda: rng.choice((*_TEXT_NUMBERS, str(_number(rng, 0.001, 1000.0, False))))  # noqa: E731
    made = folder / "made"
    box = [number() for _ in range(6)]
    some_exporter = rng.choice([*registry.backends("export")])
    known = registry.backend("export", some_exporter).options
    option = rng.choice(known) if known else None
    text = (
        f"{option.name}={rng.choice((number(), _dumped_value(_value(rng, option.kind, False))))}" if option else "a=1"
    )
    lists: list[list[Any]] = [
        ["query", scan_map, "red", "--top", number()],
        ["query", scan_map, "red", "--threshold", number()],
        ["query", scan_map, "red", "--near", f"wall:{number()}"],
        ["query", scan_map, "red", "--within", *box],
        ["query", scan_map, "red", "--refine", number(), "-o", made],
        ["query", scan_map, rng.choice(mutators.TEXTS), "--json", "--views"],
        ["scale", scan_map, "-o", made, "--factor", number()],
        ["scale", scan_map, "-o", made, "--length", f"0:{number()},{number()}", "0:5,5", number()],
        ["scale", scan_map, "-o", made, "--camera-height", number()],
        ["refine", scan_map, "-o", made, "--voxel", number(), *(["--box", *box] if rng.random() < 0.7 else [])],
        ["export", scan_map, "--format", some_exporter, "-o", made, "--set", text],
        ["export", scan_map, "--format", some_exporter, "-o", made, "--set", text],
        ["demo", made, "--frames", rng.choice(("0", "-1", "1", "nan", "1e9", "x"))],
    ]
    arguments = rng.choice(lists)
    if rng.random() < 0.1:
        return _in_python(rng, scan_map)
    return Attack(f"{' '.join(map(str, arguments[:1] + arguments[2:]))!r:.200}", functools.partial(command, *arguments))


def _in_python(rng: random.Random, scan_map: Path) -> Attack:
    """The options that Python's functions take."""
    module = rng.choice((word_query, replicaocc_truth))
    name, kind = rng.choice(list(field_types(module.Options).items()))
    value = _value(rng, kind, within=False)
    run: Callable[[], object] = lambda: module.Options(**{name: value})  # noqa: E731
    if module is word_query:
        run = lambda: freeocc3d.load_map(scan_map).query("red", **{name: value})  # noqa: E731
    return Attack(f"{module.__name__}: {_shown([(name, value)])}", run)
