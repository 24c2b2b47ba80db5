"""Command lines of the trainings: options, exit codes, one line for an error."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from training.command_line import (
    DriverTrainingOptions,
    RecordingOptions,
    report_errors,
    run_command,
    spread_options,
)
from training.imitation.config import Config


@pytest.mark.parametrize("error", [ValueError("no such kind"), FileNotFoundError("no such kind")])
def test_an_error_is_one_line_and_exit_code_2(error, capsys):
    with pytest.raises(typer.Exit) as stop, report_errors("fit"):
        raise error
    assert stop.value.exit_code == 2
    assert capsys.readouterr().err == "fit: no such kind\n"


def test_errors_of_the_program_itself_are_not_hidden():
    with pytest.raises(TypeError), report_errors("fit"):
        raise TypeError


def test_options_come_from_the_signature(monkeypatch, capsys):
    def double(number: int, times: int = 2) -> None:
        print(number * times)

    monkeypatch.setattr("sys.argv", ["double", "4", "--times", "3"])
    with pytest.raises(SystemExit) as stop:
        run_command(double)
    assert stop.value.code == 0
    assert capsys.readouterr().out == "12\n"


def test_one_source_of_recordings_is_given():
    assert RecordingOptions(ngsim=Path("a.csv")).kind_and_path() == ("ngsim", Path("a.csv"))
    for wrong in (RecordingOptions(), RecordingOptions(data=Path("a"), highd=Path("b"))):
        with pytest.raises(ValueError, match="one of --data, --ngsim, --highd, --tgsim and --i24, with a path"):
            wrong.kind_and_path()


def test_options_of_driver_trainings_have_the_defaults_of_the_settings():
    options, config = DriverTrainingOptions(), Config()
    assert (options.method, options.seed, options.updates) == (config.method, config.seed, config.updates)


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
