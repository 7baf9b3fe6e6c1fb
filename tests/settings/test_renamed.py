"""Old names of options and backends: accepted with a warning, and silently in saved maps."""

import warnings
from pathlib import Path

import pytest

from freeocc3d.core.errors import ConfigError
from freeocc3d.settings import config, registry, renamed
from freeocc3d.settings.renamed import RenamedWarning
from freeocc3d.settings.typed_options import field_types

OLD = {
    "gaussians": {"initialisation": "isotropic"},
    "tracking": {"rgbd": {"neighbours": 5}, "stereo": {"neighbours": 3}},
    "language": {"encoder": "colour", "colour": {"stride": 2}},
}


def test_old_names_are_accepted_with_a_warning_each() -> None:
    with pytest.warns(RenamedWarning) as caught:
        settings = config.resolve(OLD)
    said = [str(warning.message) for warning in caught]
    assert settings.gaussians.initialization == "isotropic"
    assert settings.stereo.neighbors == 3
    assert settings.given("tracking", "rgbd") == {"neighbors": 5}
    assert settings.language.encoder == "color"
    assert settings.given("language", "color") == {"stride": 2}
    assert sorted(text.split(":")[0] for text in said) == [
        "'gaussians.initialisation' is now called 'gaussians.initialization'",
        "'language.colour' is now called 'language.color'",
        "'language.encoder=colour' is now called 'language.encoder=color'",
        "'tracking.rgbd.neighbours' is now called 'tracking.rgbd.neighbors'",
        "'tracking.stereo.neighbours' is now called 'tracking.stereo.neighbors'",
    ]


def test_the_old_and_the_new_name_of_one_option_are_too_much() -> None:
    with pytest.raises(ConfigError, match=r"'gaussians\.initialisation' is the old name.*only the new one"):
        config.resolve({"gaussians": {"initialisation": "isotropic", "initialization": "ray_aligned"}})


def test_saved_maps_load_without_a_word(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(str(OLD).replace("'", ""))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        settings = config.load_saved(tmp_path / "config.yaml")
    assert settings.gaussians.initialization == "isotropic"
    assert settings.language.encoder == "color"
    assert settings.backend("language")[1].stride == 2
    assert settings.stereo.neighbors == 3


def test_overrides_take_old_names_too() -> None:
    with pytest.warns(RenamedWarning):
        assert config.load(None, ["gaussians.initialisation=isotropic"]).gaussians.initialization == "isotropic"


def test_a_backend_loads_by_its_old_name() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert registry.load("language.encoders", "colour") is registry.load("language.encoders", "color")


def test_options_that_are_gone_are_left_out_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(RenamedWarning, match=r"'fitting\.window' has no effect"):
        assert config.resolve({"fitting": {"window": 3, "passes": 2}}).fitting.passes == 2
    (tmp_path / "config.yaml").write_text("fitting: {window: 3, window_passes: 2, passes: 2}\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert config.load_saved(tmp_path / "config.yaml").fitting.passes == 2


def test_todays_names_are_not_warned_of() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        config.resolve(config.resolve({}).to_dict())


def test_the_table_names_what_exists() -> None:
    for old, new in renamed.OPTIONS.items():
        section, *inner, key = old.split(".")
        name = inner[0] if inner and inner[0] in config.SECTIONS else section
        if not inner or name != section:
            known = list(field_types(config.SECTIONS[name].options))
        else:
            known = [option.name for option in registry.backend(config.SECTIONS[section].folder, inner[0]).options]
        assert new in known
        assert key not in known
    for folder, names in renamed.BACKENDS.items():
        for old, new in names.items():
            assert new in registry.backends(folder)
            assert old not in registry.backends(folder)
