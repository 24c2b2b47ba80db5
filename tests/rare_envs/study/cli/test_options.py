"""Options of the command line: those of a question."""

import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from rare_envs.study.cli.options import read_count, take_options
from rare_envs.version import __version__
from tests.rare_envs.study.refusals import FOLLOWING, Cli, assert_refused


def test_a_word_of_noise_is_an_argument_of_the_problem() -> None:
    shown = []
    app = typer.Typer()
    app.command()(take_options("noise", "seed")(lambda asked: shown.append(asked)))
    for words in ([], ["--noise", "fixed"], ["--noise", "off", "--seed", "1e1"]):
        assert CliRunner().invoke(app, words).exit_code == 0
    assert shown == [{"noise": True, "seed": 0}, {"noise": "fixed", "seed": 0}, {"noise": False, "seed": 10}]


@pytest.mark.parametrize(
    ("text", "number"), [("10000", 10_000), ("1e4", 10_000), ("2.5e3", 2500), ("-5", -5), ("1_000", 1000)]
)
def test_counts_may_be_written_with_an_exponent(text: str, number: int) -> None:
    assert read_count(text) == number


@pytest.mark.parametrize("text", ["many", "1.5", "1e-3", "inf", "nan", ""])
def test_other_texts_are_no_counts(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="expected a whole number"):
        read_count(text)


def test_the_command_line_takes_them_and_tells_its_version(cli: Cli) -> None:
    found = cli("estimate", "rare_envs/CarFollowing-v0", "--method", "mc", "--max-sim", "1e2", "--json")
    assert json.loads(found.stdout)["n_sim"] == 100
    version = cli("--version")
    assert (version.exit_code, version.stdout) == (0, f"rare-envs {__version__}\n")


@pytest.mark.parametrize(
    "command",
    [
        ("estimate", FOLLOWING),
        ("compare", "idm", "human", FOLLOWING),
        ("plan", FOLLOWING),
        ("risk", "idm"),
        ("train-ego", FOLLOWING, "--steps", "10"),
        ("train-drivers", "--data", "tables", "--out", "run", "--method", "gail"),
    ],
    ids=lambda command: command[0],
)
def test_a_device_that_is_not_here_is_refused_by_each_command(
    command: tuple[str, ...], cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(cli(*command, "--device", "cuda:99"), "'cuda:99' is not here", "take 'cpu'")
    assert list(tmp_path.iterdir()) == []
