"""Command lines of the trainings: options, exit codes, one line for an error."""

from pathlib import Path

import pytest
import typer

from training.command_line import find_recordings, report_errors, run_command


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


def test_one_source_of_recordings_is_found():
    assert find_recordings(None, Path("a.csv"), None) == ("ngsim", Path("a.csv"))
    for wrong in ((None, None, None), (Path("a"), None, Path("b"))):
        with pytest.raises(ValueError, match="one of --data FOLDER, --ngsim FILE and --highd FOLDER"):
            find_recordings(*wrong)
