"""Configurations: strict in, resolved out."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from freeocc3d.core.errors import ConfigError
from freeocc3d.settings import config, registry


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_default_holds_every_key_of_every_layer() -> None:
    resolved = config.default()
    assert list(resolved) == list(config.SECTIONS)
    for section, (module, folder) in config.SECTIONS.items():
        own = {option.name: option.default for option in registry.options_of(module)}
        assert config.options(resolved, section) == own
        for name, backend in (registry.backends(folder) if folder else {}).items():
            assert resolved[section].get(name, {}) == {option.name: option.default for option in backend.options}


def test_default_is_resolved_nothing() -> None:
    assert config.default() == config.resolve({}) == config.load(None)
    assert config.resolve(config.default()) == config.default()


def test_sections_may_be_empty(tmp_path: Path) -> None:
    assert config.load(write(tmp_path / "a.yaml", "")) == config.default()
    assert config.load(write(tmp_path / "b.yaml", "tracking:\ncapture:\n")) == config.default()


def test_a_value_changes_nothing_but_itself() -> None:
    changed = config.resolve({"occupancy": {"voxel_size": 0.04}})
    assert changed["occupancy"].pop("voxel_size") == 0.04
    expected = config.default()
    del expected["occupancy"]["voxel_size"]
    assert changed == expected


def test_options_of_a_backend_nest_below_its_layer() -> None:
    resolved = config.resolve({"tracking": {"backend": "known", "known": {"keyframe_overlap": 0.7}}})
    assert resolved["tracking"]["backend"] == "known"
    assert resolved["tracking"]["known"] == {"keyframe_overlap": 0.7}
    assert resolved["tracking"]["rgbd"] == config.default()["tracking"]["rgbd"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"trackin": {}}, r"Unknown section 'trackin' \(did you mean 'tracking'\?\)"),
        ({"tracking": {"bakend": "known"}}, r"'tracking\.bakend' \(did you mean 'backend'\?\)"),
        ({"tracking": {"knwon": {}}}, r"'tracking\.knwon' \(did you mean 'known'\?\)"),
        (
            {"tracking": {"rgbd": {"keyframe_overlop": 0.5}}},
            r"'tracking\.rgbd\.keyframe_overlop' \(did you mean 'keyframe_overlap'\?\)",
        ),
        ({"tracking": {"keyframe_overlap": 0.5}}, r"Unknown key 'tracking\.keyframe_overlap'"),
        ({"occupancy": {"voxel_size": "8 cm"}}, r"'occupancy\.voxel_size' must be float, got '8 cm'"),
        ({"tracking": {"odometry": {"width": 320.5}}}, r"'tracking\.odometry\.width' must be int"),
        ({"capture": {"intrinsics": [585, 585, 320]}}, r"'capture\.intrinsics' must be tuple"),
        ({"tracking": "known"}, r"Section 'tracking' must hold 'key: value' lines, got 'known'"),
        ({"tracking": {"known": 0.5}}, r"'tracking\.known' must hold 'key: value' lines, got 0\.5"),
        ({1: {}}, "Unknown section '1'"),
        ({"tracking": {2: 3}}, r"Unknown key 'tracking\.2'"),
    ],
)
def test_what_is_wrong_is_named(values: dict[Any, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config.resolve(values)


def test_values_come_from_the_file_and_overrides_win(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", "occupancy:\n  voxel_size: 0.05\n  cutoff: 4\ntracking:\n  backend: known\n")
    loaded = config.load(path, ["occupancy.voxel_size=0.1", "tracking.odometry.width=160", "capture.stop=null"])
    assert loaded["occupancy"]["voxel_size"] == 0.1
    assert loaded["occupancy"]["cutoff"] == 4.0
    assert loaded["tracking"]["backend"] == "known"
    assert loaded["tracking"]["odometry"]["width"] == 160
    assert loaded["capture"]["stop"] is None


def test_the_last_override_wins() -> None:
    assert config.load(None, ["capture.stop=5", "capture.stop=7"])["capture"]["stop"] == 7


def test_an_override_may_hold_a_list_and_an_equals_sign() -> None:
    loaded = config.load(None, ["capture.intrinsics=[585, 585, 320, 240]", "capture.format='a=b'"])
    assert loaded["capture"]["intrinsics"] == (585.0, 585.0, 320.0, 240.0)
    assert loaded["capture"]["format"] == "a=b"


@pytest.mark.parametrize("override", ["", "capture.stop", "stop=5", "capture.=5", ".stop=5", "=5", "capture..stop=5"])
def test_malformed_overrides_are_refused(override: str) -> None:
    with pytest.raises(ConfigError, match=r"An override reads section\.key=value"):
        config.load(None, [override])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("capture.intrinsics=[1, 2", "is not valid YAML"),
        ("capture.stopp=5", r"did you mean 'stop'"),
        ("capture.stop=five", r"'capture\.stop' must be int \| None, got 'five'"),
        ("tracking.known=5", r"'tracking\.known' must hold"),
    ],
)
def test_unusable_overrides_are_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config.load(None, [override])


def test_an_override_cannot_go_below_a_value() -> None:
    with pytest.raises(ConfigError, match="'rgbd' holds a value, not a section"):
        config.load(None, ["tracking.rgbd=3", "tracking.rgbd.x=4"])


def test_a_file_that_does_not_fit_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", "trackin:\n  backend: known\n")
    with pytest.raises(ConfigError, match=r"c\.yaml: Unknown section 'trackin'"):
        config.load(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tracking: [", "is not valid YAML"),
        ("- tracking\n", "must hold sections such as 'tracking:', not a list"),
        ("!!python/object/apply:os.system ['true']\n", "is not valid YAML"),
    ],
)
def test_unusable_files_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        config.load(write(tmp_path / "c.yaml", text))
    assert "\n" not in str(caught.value)
    assert "c.yaml" in str(caught.value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.yaml"):
        config.load(tmp_path / "absent.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ConfigError, match=r"binary\.yaml is not valid YAML"):
        config.load(tmp_path / "binary.yaml")


def test_dumped_and_loaded_is_the_same(tmp_path: Path) -> None:
    settings = config.resolve(
        {
            "capture": {"intrinsics": [585, 585, 320, 240], "stop": 10},
            "tracking": {"backend": "known", "odometry": {"iterations": [4, 3, 2]}},
            "occupancy": {"voxel_size": 0.05},
        }
    )
    text = config.dump(settings)
    assert config.load(write(tmp_path / "c.yaml", text)) == settings
    assert config.dump(config.load(tmp_path / "c.yaml")) == text
    assert "!!" not in text


def test_fingerprint_changes_with_its_sections_only() -> None:
    before = config.default()
    after = config.resolve({"occupancy": {"voxel_size": 0.05}})
    assert config.fingerprint(before, ["tracking"]) == config.fingerprint(after, ["tracking"])
    assert config.fingerprint(before, ["tracking", "occupancy"]) != config.fingerprint(after, ["tracking", "occupancy"])


def test_fingerprint_survives_the_round_trip_through_a_file(tmp_path: Path) -> None:
    settings = config.resolve({"capture": {"intrinsics": [585, 585, 320, 240]}})
    loaded = config.load(write(tmp_path / "c.yaml", config.dump(settings)))
    assert config.fingerprint(loaded, config.SECTIONS) == config.fingerprint(settings, config.SECTIONS)


def test_documented_configuration_is_the_default_with_every_key_explained(tmp_path: Path) -> None:
    text = config.documented()
    assert config.load(write(tmp_path / "c.yaml", text)) == config.default()
    lines = text.splitlines()
    for before, line in pairwise(lines):
        if line.startswith("  ") and not line.lstrip().startswith("#"):
            explained = before.lstrip().startswith("#") or "#" in line
            assert explained, f"no comment above '{line}'"
    assert max(map(len, lines)) <= 120


CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.name)
def test_shipped_configurations_are_valid(path: Path) -> None:
    config.load(path)


def test_the_shipped_default_is_up_to_date() -> None:
    path = CONFIGS / "default.yaml"
    assert path.read_text(encoding="utf-8") == config.documented(), (
        "write it again: freeocc3d list --yaml > configs/default.yaml"
    )
