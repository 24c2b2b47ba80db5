"""Options of the command line: their defaults are those of a question."""

from dataclasses import fields

import pytest

from rare_envs.study.cli.options import EstimateOptions, NoiseChoice, ScenarioOptions, WorldOptions
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
