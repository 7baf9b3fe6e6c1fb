"""Presets go by name, files by path."""

from __future__ import annotations

from pathlib import Path

import pytest

from freeocc3d.capture.class_files import read_class_file
from freeocc3d.core.errors import ConfigError
from freeocc3d.settings import config
from freeocc3d.settings.presets import find_preset, list_presets

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("mono", "mono.yaml"),
        ("ablations/mono", "ablations/mono.yaml"),
        ("rgbd_no_loops", "ablations/rgbd_no_loops.yaml"),
    ],
)
def test_a_configuration_goes_by_its_name(name: str, file: str) -> None:
    assert find_preset(name).resolve() == CONFIGS / file
    assert config.load(Path(name)) == config.load(CONFIGS / file)


def test_every_file_of_the_repository_is_a_preset() -> None:
    names = [*list_presets(), *(f"classes/{name}" for name in list_presets("classes"))]
    assert {CONFIGS / f"{name}.yaml" for name in names} == set(CONFIGS.rglob("*.yaml"))


def test_class_files_go_by_name() -> None:
    assert read_class_file(Path("nyu40_to_embodiedocc")).names[0] == "ceiling"


def test_a_file_comes_before_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mono").mkdir()
    assert find_preset("mono").name == "mono.yaml"  # a map's folder is no configuration
    (tmp_path / "rgbd").write_text("occupancy: {voxel_size: 0.05}\n")
    assert config.load(Path("rgbd")).occupancy.voxel_size == 0.05


def test_paths_are_left_as_they_are(tmp_path: Path) -> None:
    for path in (tmp_path / "absent", Path("configs/absent.yaml"), CONFIGS / "mono.yaml"):
        assert find_preset(path) == path


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [
        (
            "momo",
            "configuration",
            r"There is no file or preset 'momo'.*did you mean 'mono'.*presets default, mono, [a-z, ]*\.$",
        ),
        ("nyu40", "classes", r"one of the presets house_to_embodiedocc, nyu40_to_embodiedocc\."),
    ],
)
def test_an_unknown_name_lists_what_there_is(name: str, kind: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        find_preset(name, kind)  # type: ignore[arg-type]
