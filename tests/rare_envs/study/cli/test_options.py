"""Options of the command line: their defaults are those of a question, and groups spread into commands."""

from dataclasses import fields

import pytest
import typer
from typer.testing import CliRunner

from rare_envs.study.cli.options import EstimateOptions, NoiseChoice, ScenarioOptions, WorldOptions, spread_options
from rare_envs.study.ego_check.subprocess_check import EgoCheckRequest
from rare_envs.study.question import Question


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


def test_a_group_is_options_of_the_command() -> None:
    app = typer.Typer()

    @app.command()
    @spread_options
    def show(env: str, options: WorldOptions, steps: int = 3) -> None:
        print(env, options.base, options.noise.value, options.weather, steps)

    result = CliRunner().invoke(app, ["here", "--base", "highway", "--noise", "off", "--weather", "--steps", "5"])
    assert result.output == "here highway off True 5\n"
    assert CliRunner().invoke(app, ["here"]).output == "here None on False 3\n"
    assert CliRunner().invoke(app, ["here", "--options", "x"]).exit_code == 2
