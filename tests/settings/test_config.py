"""Configurations: strict in, resolved out."""

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from freeocc3d.core.errors import ConfigError
from freeocc3d.settings import config, registry, stages
from freeocc3d.settings.syntax_trees import options_of


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_default_holds_every_option_of_every_stage_and_of_the_chosen_backends() -> None:
    resolved = config.resolve({})
    assert list(resolved.to_dict()) == [name for name, section in config.SECTIONS.items() if not section.within]
    for name, section in config.SECTIONS.items():
        own = {option.name: option.default for option in options_of(stages.__name__, section.options.__name__)}
        assert getattr(resolved, name) == section.options()
        assert getattr(resolved, name).to_dict() == own
    for section, name in (("tracking", "rgbd"), ("language", "color")):
        backend = registry.backend(config.SECTIONS[section].folder, name)
        assert resolved.to_dict()[section][name] == {option.name: option.default for option in backend.options}


def test_default_is_resolved_nothing() -> None:
    default = config.resolve({})
    assert config.load(None) == default
    assert config.resolve(default) is default
    assert config.resolve(default.to_dict()) == default


def test_sections_may_be_empty(tmp_path: Path) -> None:
    assert config.load(write(tmp_path / "a.yaml", "")) == config.resolve({})
    assert config.load(write(tmp_path / "b.yaml", "tracking:\ncapture:\n")) == config.resolve({})


def test_a_value_changes_nothing_but_itself() -> None:
    changed = config.resolve({"occupancy": {"voxel_size": 0.04}})
    assert changed.occupancy.voxel_size == 0.04
    assert changed == config.resolve({}).changed("occupancy", voxel_size=0.04)
    assert changed.changed("occupancy", voxel_size=0.08) == config.resolve({})


def test_options_of_a_backend_nest_below_its_layer() -> None:
    resolved = config.resolve({"tracking": {"backend": "known", "known": {"keyframe_overlap": 0.7}}})
    assert resolved.tracking.backend == resolved.chosen("tracking") == "known"
    assert resolved.given("tracking", "known") == {"keyframe_overlap": 0.7}
    module, options = resolved.backend("tracking")
    assert options == module.Options(keyframe_overlap=0.7)


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
        (
            {"occupancy": {"voxel_size": "8 cm"}},
            r"'occupancy\.voxel_size' must be a number from .* 100, got '8 cm'",
        ),
        ({"occupancy": {"voxel_size": -1}}, r"^'occupancy\.voxel_size' must be from 0\.001 to 100, got -1\.$"),
        (
            {"tracking": {"odometry": {"width": 320.5}}},
            r"'tracking\.odometry\.width' must be a whole number from 16 to 4096",
        ),
        ({"tracking": {"stereo": {"size": 10}}}, r"'tracking\.stereo\.size' must be from 64 to 4096, got 10"),
        ({"tracking": {"stereo": 3}}, r"'tracking\.stereo' must contain 'key: value' lines, got 3"),
        ({"tracking": {"stero": {}}}, r"'tracking\.stero' \(did you mean 'stereo'\?\)"),
        ({"capture": {"intrinsics": [585, 585, 320]}}, r"'capture\.intrinsics' must be a list of 4 numbers"),
        (
            {"gaussians": {"initialization": "x"}},
            r"'gaussians\.initialization' must be disc, ray_aligned or isotropic, got 'x'",
        ),
        ({"vocabulary": {"endpoint": "http://h/v1"}}, r"'vocabulary\.endpoint' names a server, so 'vocabulary\.model'"),
        ({"fitting": {"cpu": {"x": 1}}}, r"'fitting\.cpu' has no options\. Remove x"),
        ({"fitting": {"gsplat": {"devise": "x"}}}, r"'fitting\.gsplat\.devise' \(did you mean 'device'\?\)"),
        ({"tracking": "known"}, r"section 'tracking' must contain 'key: value' lines, got 'known'"),
        ({"tracking": {"known": 0.5}}, r"'tracking\.known' must contain 'key: value' lines, got 0\.5"),
        ({1: {}}, "Unknown section '1'"),
        ({"tracking": {2: 3}}, r"Unknown key 'tracking\.2'"),
    ],
)
def test_what_is_wrong_is_named(values: dict[Any, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config.resolve(values)


@pytest.mark.parametrize("given", ["mono", None, [], 5])
def test_settings_that_are_no_mapping_are_refused(given: Any) -> None:
    with pytest.raises(ConfigError, match="Settings are a mapping of sections"):
        config.resolve(given)


def test_values_come_from_the_file_and_overrides_win(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", "occupancy:\n  voxel_size: 0.05\n  cutoff: 4\ntracking:\n  backend: known\n")
    loaded = config.load(path, ["occupancy.voxel_size=0.1", "tracking.odometry.width=160", "capture.stop=null"])
    assert loaded.occupancy.voxel_size == 0.1
    assert loaded.occupancy.cutoff == 4.0
    assert loaded.tracking.backend == "known"
    assert loaded.given("tracking", "odometry") == {"width": 160}
    assert loaded.capture.stop is None


def test_the_last_override_wins() -> None:
    assert config.load(None, ["capture.stop=5", "capture.stop=7"]).capture.stop == 7


def test_an_override_may_hold_a_list_and_an_equals_sign() -> None:
    loaded = config.load(None, ["capture.intrinsics=[585, 585, 320, 240]", "capture.format='a=b'"])
    assert loaded.capture.intrinsics == (585.0, 585.0, 320.0, 240.0)
    assert loaded.capture.format == "a=b"


@pytest.mark.parametrize("override", ["", "capture.stop", "stop=5", "capture.=5", ".stop=5", "=5", "capture..stop=5"])
def test_malformed_overrides_are_refused(override: str) -> None:
    with pytest.raises(ConfigError, match=r"An override has the form section\.key=value"):
        config.load(None, [override])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("capture.intrinsics=[1, 2", "is not valid YAML"),
        ("capture.stopp=5", r"did you mean 'stop'"),
        ("capture.stop=five", r"'capture\.stop' must be a whole number of at least 0 or null, got 'five'"),
        ("tracking.known=5", r"'tracking\.known' must contain"),
    ],
)
def test_unusable_overrides_are_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config.load(None, [override])


def test_an_override_cannot_go_below_a_value() -> None:
    with pytest.raises(ConfigError, match="'rgbd' is a value, not a section"):
        config.load(None, ["tracking.rgbd=3", "tracking.rgbd.x=4"])


def test_a_file_that_does_not_fit_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", "trackin:\n  backend: known\n")
    with pytest.raises(ConfigError, match=r"c\.yaml: Unknown section 'trackin'"):
        config.load(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tracking: [", "is not valid YAML"),
        ("- tracking\n", "must contain sections such as 'tracking:', got a list"),
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
    before = config.resolve({})
    after = config.resolve({"occupancy": {"voxel_size": 0.05}})
    assert config.fingerprint(before, ["tracking"]) == config.fingerprint(after, ["tracking"])
    assert config.fingerprint(before, ["tracking", "occupancy"]) != config.fingerprint(after, ["tracking", "occupancy"])


def test_fingerprint_survives_the_round_trip_through_a_file(tmp_path: Path) -> None:
    settings = config.resolve({"capture": {"intrinsics": [585, 585, 320, 240]}})
    loaded = config.load(write(tmp_path / "c.yaml", config.dump(settings)))
    sections = list(settings.to_dict())
    assert config.fingerprint(loaded, sections) == config.fingerprint(settings, sections)
    assert config.fingerprint(loaded, sections, "other") != config.fingerprint(settings, sections)


def test_numbers_may_be_written_without_a_point(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", "occupancy: {voxel_size: 1e-2}\n")
    assert config.load(path, ["carving.miss=2e-1"]).occupancy.voxel_size == 0.01
    assert config.load(path, ["carving.miss=2e-1"]).carving.miss == 0.2


def test_a_backend_that_is_not_chosen_is_checked_even_if_its_package_is_not_installed() -> None:
    with pytest.raises(ConfigError, match=r"'language\.labels\.stride' must be from 1 to 4096, got 0"):
        config.resolve({"language": {"labels": {"stride": 0}}})
    with pytest.raises(ConfigError, match=r"'fitting\.gsplat\.device' must be a device such as cpu or cuda:0, got 3"):
        config.resolve({"fitting": {"gsplat": {"device": 3}}})
    given = config.resolve({"fitting": {"gsplat": {"device": "cuda:1"}}}).given("fitting", "gsplat")
    assert given == {"device": "cuda:1"}


NAMES: list[Any] = ["x" * 10**6, "a\0b", "a\nb", "\ud800", "../export/npz", "", None, 1.5, 10**5000, True, ()]


@pytest.mark.parametrize("name", NAMES, ids=[str(k) for k in range(len(NAMES))])
def test_any_unknown_name_is_refused_in_one_line(name: Any) -> None:
    given: list[dict[Any, Any]] = [{name: {}}, {"tracking": {name: 1}}, {"tracking": {"rgbd": {name: 1}}}]
    for values in given:
        with pytest.raises(ConfigError, match=r"^Unknown (section|key) '.*\.$") as error:
            config.resolve(values)
        assert len(str(error.value)) < 500
    if isinstance(name, str):
        with pytest.raises(ConfigError) as error:
            config.resolve({"tracking": {"backend": name}}).backend("tracking")
        assert len(str(error.value)) < 500


def test_what_is_given_at_its_default_imports_no_backend() -> None:
    code = (
        "import sys\nfrom freeocc3d.settings import config\n"
        "config.resolve({'tracking': {'rgbd': {'keyframe_overlap': 0.8}}, 'language': {'encoder': 'clip'}})\n"
        "assert not [name for name in sys.modules if 'trackers' in name or 'encoders' in name]"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_section_loads_its_backend_with_its_options() -> None:
    settings = config.resolve({"language": {"encoder": "color", "color": {"stride": 2}}})
    assert settings.load_backend("language", None).options.stride == 2
    assert config.resolve({}).load_backend("fitting").device.type == "cpu"
    assert settings.has_backend_option("language", "stride")
    assert not settings.has_backend_option("fitting", "device")
    changed = settings.with_backend("language", white=(200, 200, 200))
    assert changed.given("language", "color") == {"stride": 2, "white": (200.0, 200.0, 200.0)}
    assert settings.given("language", "color") == {"stride": 2}


def test_a_saved_configuration_is_read_without_what_it_does_not_choose(tmp_path: Path) -> None:
    path = write(
        tmp_path / "c.yaml",
        "language: {encoder: color, color: {stride: 2}, clip: {gone: 3}}\ntracking: {rgbd: {refine: false}}\n",
    )
    settings = config.load_saved(path)
    assert settings.backends == {"language": {"color": {"stride": 2}}, "tracking": {"rgbd": {"refine": False}}}
    white = "language.color.white=[200, 200, 200]"
    changed = config.load_saved(path, ["occupancy.threshold=0.4", white])
    assert changed.occupancy.threshold == 0.4
    assert changed.given("language", "color") == {"stride": 2, "white": (200, 200, 200)}  # what is not overridden stays
    assert changed.given("tracking", "rgbd") == {"refine": False}
    with pytest.raises(ConfigError, match=r"'occupancy\.treshold' \(did you mean 'threshold'\?\)"):
        config.load_saved(path, ["occupancy.treshold=0.4"])


def test_numbers_of_an_older_map_are_brought_into_range(tmp_path: Path) -> None:
    path = write(
        tmp_path / "c.yaml",
        "carving: {miss: 200, min_free: 0, margin: 1}\ntracking: {stereo: {size: 1}}\noccupancy: {finest: null}\n",
    )
    with pytest.raises(ConfigError, match=r"'tracking\.stereo\.size' must be from 64"):
        config.load(path)
    for settings in (config.load_saved(path), config.load_saved(path, ["occupancy.threshold=0.4"])):
        assert (settings.carving.miss, settings.carving.min_free, settings.carving.margin) == (100, 1, 1.0)
        assert settings.stereo.size > 1
        assert {notice.code for notice in settings.notices} == {"option-clamped"}
        assert [notice.text.split("'")[1] for notice in settings.notices] == [
            "tracking.stereo.size",
            "carving.miss",
            "carving.min_free",
        ]
        assert "was 200, which is out of range: 100 is used" in settings.notices[1].text
    for wrong in ("miss: x", "miss: .nan", "miss: [2]", "miss: true"):
        with pytest.raises(ConfigError, match=r"'carving\.miss' must be"):
            config.load_saved(write(tmp_path / "d.yaml", f"carving: {{{wrong}}}\n"))


CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize(
    "path", sorted([*CONFIGS.glob("*.yaml"), *CONFIGS.glob("ablations/*.yaml")]), ids=lambda path: path.stem
)
def test_shipped_configurations_are_valid(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        config.load(path)
