"""The generated configuration: whole, explained, up to date."""

from itertools import pairwise
from pathlib import Path

from freeocc3d.settings import config, registry
from freeocc3d.settings.default_yaml import default_yaml
from freeocc3d.settings.yaml_files import parse_yaml

SHIPPED = Path(__file__).parents[2] / "configs" / "default.yaml"


def test_it_is_the_default_with_every_key_explained(tmp_path: Path) -> None:
    text = default_yaml()
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    assert config.load(tmp_path / "c.yaml") == config.resolve({})
    lines = text.splitlines()
    for before, line in pairwise(lines):
        if line.startswith("  ") and not line.lstrip().startswith("#"):
            explained = before.lstrip().startswith("#") or "#" in line
            assert explained, f"no comment above '{line}'"
    assert max(map(len, lines)) <= 120


def test_it_holds_every_option_of_every_backend() -> None:
    values = parse_yaml(default_yaml())
    for name, section in config.SECTIONS.items():
        for backend in registry.backends(section.folder).values() if section.folder else ():
            assert list(values[name].get(backend.name, {})) == [option.name for option in backend.options]


def test_advanced_options_are_marked() -> None:
    lines = default_yaml().splitlines()
    assert any(line.startswith("  # (advanced) Elongation along the viewing ray") for line in lines)
    assert not any("(advanced) Edge of a voxel" in line for line in lines)


def test_the_shipped_file_is_up_to_date() -> None:
    assert SHIPPED.read_text(encoding="utf-8") == default_yaml(), (
        "write it again: python -m freeocc3d.settings.default_yaml > configs/default.yaml"
    )
