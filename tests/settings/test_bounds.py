"""Every number that a user can set has a lower and an upper bound."""

import math
from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin

import pytest

from freeocc3d.core.errors import ConfigError
from freeocc3d.evaluation import replicaocc_truth
from freeocc3d.query import word_query
from freeocc3d.settings import config, registry, stages
from freeocc3d.settings.option_types import Device, converted, described
from freeocc3d.settings.syntax_trees import options_of
from freeocc3d.settings.typed_options import field_types


def kinds() -> Iterator[tuple[str, Any]]:
    """Name -> type of every option: of the stages, of all backends, of queries, of ground truth."""
    for name, section in config.SECTIONS.items():
        for option in options_of(stages.__name__, section.options.__name__):
            yield f"{name}.{option.name}", option.kind
    for folder in registry.FOLDERS:
        for backend in registry.backends(folder).values():
            for option in backend.options:
                yield f"{folder}.{backend.name}.{option.name}", option.kind
    for module in (word_query, replicaocc_truth):
        for name, kind in field_types(module.Options).items():
            yield f"{module.__name__}.{name}", kind


def numbers(kind: Any) -> Iterator[tuple[type, float, float]]:
    """The bounds of each number in a type, infinite where it declares none."""
    base = kind.__origin__ if hasattr(kind, "__metadata__") else kind
    if base in (int, float):
        metas = kind.__metadata__ if base is not kind else ()
        low = [bound for meta in metas for bound in (meta.gt, meta.ge) if bound is not None]
        high = [bound for meta in metas for bound in (meta.lt, meta.le) if bound is not None]
        yield base, max(low, default=-math.inf), min(high, default=math.inf)
    elif get_origin(base) is not Literal:
        for part in get_args(base):
            yield from numbers(part)


def number_of(kind: Any, value: float) -> Any:
    """The value in the form that a type wants: alone, or as each of the items of a list."""
    lists = [part for part in (kind, *get_args(kind)) if get_origin(getattr(part, "__origin__", part)) is tuple]
    return [value] * (len(get_args(lists[0])) or 1) if lists else value


KINDS = list(kinds())
NUMBERS = [(name, kind, *bounds) for name, kind in KINDS for bounds in numbers(kind)]


def test_the_options_are_found() -> None:
    assert len(KINDS) > 120
    assert len(NUMBERS) > 80


@pytest.mark.parametrize(("name", "kind", "base", "low", "high"), NUMBERS)
def test_every_number_is_bounded(name: str, kind: Any, base: type, low: float, high: float) -> None:
    assert -1e9 <= low < high <= 2**32, f"{name} is {described(kind)}: declare both bounds"
    for value in (base(2**33), base(-(2**33)), 2**63, 10**400, float("inf"), float("nan")):
        with pytest.raises(ConfigError):
            converted(kind, number_of(kind, value), name)


@pytest.mark.parametrize(("name", "kind"), [(name, kind) for name, kind in KINDS if name.endswith("device")])
def test_every_device_is_checked(name: str, kind: Any) -> None:
    assert kind == Device, name


@pytest.mark.parametrize(
    "override",
    [
        "gaussians.gamma=1e30", "gaussians.gamma=1000", "carving.hit=1e9", "carving.hit=200",
        "occupancy.voxel_size=1e-9", "occupancy.voxel_size=1e99", "occupancy.voxel_size=1e300", "occupancy.cutoff=1e4",
        "capture.synthetic.width=1000000", "capture.synthetic.height=9223372036854775808", "capture.synthetic.seed=-1",
        "fitting.passes=1000000", "language.color.stride=2147483648", "fitting.reference.device=''",
        "fitting.gsplat.device=5", "capture.stop=-8", "tracking.file.points=''", "language.encoder=\"a\\0b\"",
        "capture.max_depth=1e-300", "tracking.rgbd.keyframe_overlap=1e300",
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_by_its_name(override: str) -> None:
    name = override.partition("=")[0]
    with pytest.raises(ConfigError, match=f"^'{name}' must be "):
        config.load(None, [override])
