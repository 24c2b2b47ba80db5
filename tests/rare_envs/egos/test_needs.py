"""Needs of an ego: read from what it declares, once."""

from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium import spaces

import agents
import rare_envs
from rare_envs.egos.needs import PerceivingDriver, WrappedEgo, resolve
from rare_envs.simulation.ego_interface import EgoNeeds
from rare_envs.simulation.observation import observation_space

CUT_IN = "rare_envs/CutIn-v0"


class Declared:
    """A policy with the attributes that it is given."""

    def __init__(self, **attributes: Any) -> None:
        self.__dict__.update(attributes)

    def predict(self, observation: Any, **_: Any) -> Any:
        return np.zeros((len(observation), 2)), None


def test_an_ego_that_declares_nothing_needs_nothing() -> None:
    assert resolve("idm") == EgoNeeds()
    assert resolve(Declared()) == EgoNeeds(queries_policy=True)


@pytest.mark.parametrize(
    ("space", "vehicles", "fitting"),
    [
        (observation_space(3, "lidar"), 3, ("lidar",)),
        (observation_space(13, "lidar"), 13, ("features", "lidar")),  # as many numbers as the lidar has
        (spaces.Dict({}), 3, ()),
        (None, 3, ("features",)),
    ],
)
def test_what_it_observes_is_read_from_its_space(space: Any, vehicles: int, fitting: tuple[str, ...]) -> None:
    assert resolve(Declared(observation_space=space), vehicles).observations == fitting


def test_only_a_plain_no_says_that_answers_vary() -> None:
    for declared, varies in ((False, True), (True, False), (None, False), (0, False)):
        assert resolve(Declared(deterministic=declared)).varies is varies


def test_a_driver_that_perceives_needs_the_lidar_and_queries_no_policy() -> None:
    ego = agents.load_ego("mgail")
    assert isinstance(ego, PerceivingDriver)
    needs = resolve(ego, vehicles=3)
    assert (needs.lidar, needs.queries_policy) == (True, False)
    assert rare_envs.DrivingProblem(CUT_IN, ego=ego, horizon=0.1).world.uses_lidar


def test_a_wrapped_ego_needs_what_the_one_behind_it_needs_and_its_own_noise() -> None:
    class Behind:
        ego: ClassVar[Any] = Declared(observation_space=observation_space(3, "lidar"), dt=0.2, deterministic=False)

        def noise_columns(self, world: Any) -> int:
            return 7 * world.clock.ticks

        def in_world(self, world: Any) -> Any:
            raise AssertionError("An ego is not driven to find its needs.")

    ego = Behind()
    assert isinstance(ego, WrappedEgo)
    needs = resolve(ego, vehicles=3)
    assert (needs.observation, needs.dt, needs.varies, needs.queries_policy) == ("lidar", 0.2, True, True)
    assert needs.noise_columns(rare_envs.DrivingProblem(CUT_IN, horizon=0.5).world) == 35


def test_the_noise_of_a_stack_stands_behind_all_other_columns() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=agents.load_ego("noisy:idm"), horizon=1.0)
    assert problem.space.names[-1] == "ego_noise"
    assert problem.dim == 6 + problem.needs.noise_columns(problem.world)
    assert rare_envs.DrivingProblem(CUT_IN, ego=agents.load_ego("noisy:idm"), horizon=1.0, noise=False).dim == 6
