"""Options of the command line: their defaults are those of a question."""

import json
from dataclasses import fields
from pathlib import Path

import pytest
import typer

from rare_envs.study.cli.options import EstimateOptions, NoiseChoice, ScenarioOptions, WorldOptions, read_count
from rare_envs.study.ego_check.subprocess_check import EgoCheckRequest
from rare_envs.study.question import Question
from rare_envs.version import __version__
from tests.rare_envs.study.refusals import FOLLOWING, Cli, assert_refused


def test_defaults_are_those_of_a_question() -> None:
    assert Question(env_id="rare_envs/CutIn-v0", **EstimateOptions().arguments()) == Question(
        env_id="rare_envs/CutIn-v0"
    )
    assert {field.name for field in fields(Question)} == {field.name for field in fields(EstimateOptions)} | {"env_id"}


def test_defaults_are_those_of_a_check() -> None:
    assert EgoCheckRequest("idm", "rare_envs/CutIn-v0", **ScenarioOptions().arguments()) == EgoCheckRequest(
        "idm", "rare_envs/CutIn-v0"
    )


@pytest.mark.parametrize(("choice", "argument"), [("on", True), ("fixed", "fixed"), ("off", False)])
def test_noise_is_an_argument_of_the_problem(choice: str, argument: bool | str) -> None:
    assert WorldOptions(noise=NoiseChoice(choice)).arguments()["noise"] is argument


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
