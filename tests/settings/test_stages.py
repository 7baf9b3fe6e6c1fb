"""The options of the stages: every default has its type, and every number has a range."""

from typing import Any

import pytest

from freeocc3d.core.errors import ConfigError
from freeocc3d.settings import config
from freeocc3d.settings.option_types import converted, described
from freeocc3d.settings.stages import VocabularyOptions
from freeocc3d.settings.typed_options import field_types

FIELDS = [
    (name, key, kind) for name, section in config.SECTIONS.items() for key, kind in field_types(section.options).items()
]


@pytest.mark.parametrize(("section", "key", "kind"), FIELDS)
def test_defaults_fit_and_infinite_numbers_do_not(section: str, key: str, kind: Any) -> None:
    default = getattr(config.SECTIONS[section].options(), key)
    assert converted(kind, default, key) == default
    if "number" in described(kind):
        with pytest.raises(ConfigError, match=f"'{key}' must be"):
            converted(kind, float("inf"), key)


def test_a_server_needs_a_model() -> None:
    with pytest.raises(ConfigError, match="'endpoint' names a server, so 'model' must name the model"):
        VocabularyOptions(endpoint="http://localhost/v1")
