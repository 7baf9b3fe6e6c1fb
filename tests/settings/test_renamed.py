"""Old names of options and backends: accepted with a warning, and silently in saved maps."""

from pathlib import Path

import pytest

from freeocc3d.core.errors import ConfigError
from freeocc3d.settings import config, registry, renamed
from freeocc3d.settings.typed_options import field_types

OLD = {
    "gaussians": {"initialisation": "isotropic"},
    "tracking": {"rgbd": {"neighbours": 5}, "stereo": {"neighbours": 3}},
    "language": {"encoder": "colour", "colour": {"stride": 2}},
}


def test_old_names_are_accepted_with_a_warning_each() -> None:
    settings = config.resolve(OLD)
    assert {notice.code for notice in settings.notices} == {"option-renamed"}
    said = [notice.text for notice in settings.notices]
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
    settings = config.load_saved(tmp_path / "config.yaml")
    assert settings.notices == ()
    assert settings.gaussians.initialization == "isotropic"
    assert settings.language.encoder == "color"
    assert settings.backend("language")[1].stride == 2
    assert settings.stereo.neighbors == 3


def test_overrides_take_old_names_too() -> None:
    settings = config.load(None, ["gaussians.initialisation=isotropic"])
    assert settings.gaussians.initialization == "isotropic"
    assert len(settings.notices) == 1


def test_a_backend_loads_by_its_old_name() -> None:
    assert registry.load("language.encoders", "colour") is registry.load("language.encoders", "color")


def test_options_that_are_gone_are_left_out_with_a_warning(tmp_path: Path) -> None:
    settings = config.resolve({"fitting": {"window": 3, "passes": 2}})
    assert settings.fitting.passes == 2
    (notice,) = settings.notices
    assert notice.code == "option-removed"
    assert notice.text.startswith("'fitting.window' has no effect")
    (tmp_path / "config.yaml").write_text("fitting: {window: 3, window_passes: 2, passes: 2}\n")
    saved = config.load_saved(tmp_path / "config.yaml")
    assert (saved.fitting.passes, saved.notices) == (2, ())


def test_todays_names_are_not_warned_of() -> None:
    assert config.resolve(config.resolve({}).to_dict()).notices == ()


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
