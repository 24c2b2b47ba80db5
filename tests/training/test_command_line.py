"""Command lines of the trainings: options, exit codes, one line for an error."""

from dataclasses import dataclass
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from training.command_line import report_errors, spread_options


def test_an_error_of_the_user_is_one_line_and_exit_code_2(capsys):
    for error in (ValueError("no such kind"), FileNotFoundError("no such kind")):
        with pytest.raises(typer.Exit) as stop, report_errors("fit"):
            raise error
        assert stop.value.exit_code == 2
        assert capsys.readouterr().err == "fit: no such kind\n"
    with pytest.raises(TypeError), report_errors("fit"):  # the program's own are not hidden
        raise TypeError


@dataclass(frozen=True, kw_only=True)
class Colours:
    """Options of a group."""

    paint: Annotated[str | None, typer.Option(help="Its colour.")] = None
    glossy: Annotated[bool, typer.Option("--glossy")] = False


def test_a_group_is_options_of_the_command():
    app = typer.Typer()

    @app.command()
    @spread_options
    def show(name: str, options: Colours, steps: int = 3) -> None:
        print(name, options.paint, options.glossy, steps)

    assert CliRunner().invoke(app, ["car", "--paint", "red", "--glossy", "--steps", "5"]).output == "car red True 5\n"
    assert CliRunner().invoke(app, ["car"]).output == "car None False 3\n"
    assert CliRunner().invoke(app, ["car", "--options", "x"]).exit_code == 2
