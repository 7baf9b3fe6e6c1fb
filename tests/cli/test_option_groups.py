"""Commands that take their options in records."""

from dataclasses import dataclass
from typing import Annotated

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from freeocc3d.cli.option_groups import grouped


@dataclass(frozen=True)
class Where:
    """Where it is. This sentence is no title."""

    room: Annotated[str, typer.Argument(help="Room.")]
    floor: Annotated[int, typer.Option("--floor", help="Floor.")] = 3


@pytest.fixture
def app() -> typer.Typer:
    made = typer.Typer()

    @made.command()
    @grouped
    def find(where: Where, loud: Annotated[bool, typer.Option("--loud", help="Loudly.")] = False) -> None:
        """Find it."""
        print(where, loud)

    return made


def test_records_are_filled_and_other_options_pass_as_they_are(app: typer.Typer) -> None:
    done = CliRunner().invoke(app, ["kitchen", "--floor", "2", "--loud"])
    assert done.output == "Where(room='kitchen', floor=2) True\n"
    assert CliRunner().invoke(app, ["kitchen"]).output == "Where(room='kitchen', floor=3) False\n"
    assert CliRunner().invoke(app, []).exit_code == 2


def test_the_help_page_has_the_records_title(app: typer.Typer) -> None:
    command = get_command(app)
    groups = {parameter.name: getattr(parameter, "rich_help_panel", None) for parameter in command.params}
    assert groups["floor"] == "Where it is. This sentence is no title"
    assert groups["room"] is None
    assert groups["loud"] is None
    assert command.help == "Find it."
