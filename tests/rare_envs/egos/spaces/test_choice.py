"""Observation and actions of a policy found by its spaces."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import rare_envs
from rare_envs.egos.needs import AmbiguousActions, choose_action, choose_observation, find_fitting_kinds, takes_indices
from rare_envs.sensors.kinds import OBSERVATIONS
from rare_envs.simulation.ego_interface import EgoNeeds
from rare_envs.simulation.observation import observation_space

CUT_IN, KINEMATICS = "rare_envs/CutIn-v0", "rare_envs/CutIn-kinematics-v0"


class Idle:
    """A policy with the spaces that it is given."""

    def __init__(self, observed: Any = None, acted: Any = None) -> None:
        self.observation_space, self.action_space = observed, acted

    def predict(self, observation: Any, **_: Any) -> Any:
        return np.ones(len(observation), np.int64), None


@pytest.mark.parametrize("kind", [*OBSERVATIONS, "camera+speed"])
def test_each_kind_is_known_by_its_space(kind: str) -> None:
    assert find_fitting_kinds(observation_space(3, kind), vehicles=3) == (kind,)


@pytest.mark.parametrize(
    ("space", "fitting"),
    [
        (spaces.Box(-5, 5, (44,)), ("features",)),  # four frames side by side
        (spaces.Box(-5, 5, (4, 51)), ("lidar",)),
        (spaces.Box(0, 255, (12, 40, 80), np.uint8), ("camera",)),  # four frames of another size, channels first
        (spaces.Box(0, 255, (84, 84, 12), np.uint8), ("camera",)),
        (spaces.Box(0, 255, (4, 3, 84, 84), np.uint8), ("camera",)),  # four frames on an axis of their own
        (spaces.Box(0, 255, (4, 128, 64), np.uint8), ()),  # HighwayEnv's grayscale
        (spaces.Box(0, 255, (1, 84, 84), np.uint8), ()),
        (spaces.Box(0, 255, (4, 84, 84), np.uint8), ()),
        (spaces.Box(0, 255, (84, 84, 4), np.uint8), ()),
        (spaces.Box(-1, 1, (7, 11, 11)), ()),  # its occupancy grid
        (spaces.Box(-1, 1, (15, 7)), ()),
        (spaces.Box(-1, 1, (97,)), ()),
        (spaces.Dict({"radar": spaces.Box(0, 1, (3,))}), ()),
        (spaces.Dict({}), ()),
        ("Box", ()),
    ],
)
def test_what_else_fits(space: Any, fitting: tuple[str, ...]) -> None:
    assert find_fitting_kinds(space, vehicles=3) == fitting


def test_several_or_none_are_refused_in_a_line() -> None:
    both = find_fitting_kinds(observation_space(13, "lidar"), vehicles=13)
    with pytest.raises(ValueError, match="fit features and lidar: say which"):
        choose_observation(EgoNeeds(observations=both), vehicles=13)
    grayscale = [spaces.Box(0, 255, shape, np.uint8) for shape in ((1, 84, 84), (4, 84, 84), (84, 84, 4))]
    others = [spaces.Box(-1, 1, shape) for shape in ((15, 7), (4, 128, 64), (7, 11, 11))]
    for space, elsewhere in ((spaces.Box(-1, 1, (97,)), False), *((each, True) for each in (*grayscale, *others))):
        with pytest.raises(ValueError, match=r"features \(11,\), lidar \(51,\), kinematics \(5, 5\)") as refused:
            rare_envs.DrivingProblem(CUT_IN, ego=Idle(space))
        assert ("rare_envs.highway_env_problem" in str(refused.value)) == elsewhere
        assert "\n" not in str(refused.value)


def test_a_policy_of_highway_env_says_by_its_id_or_by_hand_what_its_actions_are() -> None:
    ego = Idle(observation_space(3, "kinematics"), spaces.Discrete(5))
    with pytest.raises(ValueError, match=r"fit two kinds.*--action meta.*--action discrete"):
        rare_envs.DrivingProblem(CUT_IN, ego=ego)
    for env_id, asked, action in (
        (KINEMATICS, {}, "meta"),
        (KINEMATICS, {"observation": None, "action": None}, "meta"),
        (CUT_IN, {"action": "meta"}, "meta"),
        (CUT_IN, {"action": "discrete"}, "discrete"),
    ):
        problem = rare_envs.DrivingProblem(env_id, ego=ego, **asked)
        assert (problem.world.sensing.observation, problem.world.clock.action) == ("kinematics", action)
        assert problem.notes == ()


def test_other_policies_are_taken_to_accelerate() -> None:
    for acted, indices in ((spaces.Discrete(5), True), (spaces.Discrete(3), False), (None, False)):
        assert takes_indices(acted) is indices
        assert choose_action(acted, "lidar") == "continuous"
    problem = rare_envs.DrivingProblem(CUT_IN, ego=Idle(observation_space(3, "features"), spaces.Discrete(5)))
    assert len(problem.notes) == 1 and "--action meta" in problem.notes[0]  # and no warning
    x = problem.base.sample(4, np.random.default_rng(0))
    said = rare_envs.DrivingProblem(CUT_IN, ego=problem.ego, action="discrete")
    np.testing.assert_array_equal(problem.evaluate(x), said.evaluate(x))


@pytest.mark.parametrize("action", ["meta", "discrete"])
def test_an_ego_that_drives_itself_says_that_named_actions_change_nothing(action: str) -> None:
    told = f"the ego accelerates and steers by itself: action='{action}' (--action {action}) changes nothing for it"
    plain = rare_envs.DrivingProblem(CUT_IN, ego="imitation")
    assert plain.notes == ()
    with pytest.warns(AmbiguousActions) as warned:
        named = rare_envs.DrivingProblem(CUT_IN, ego="imitation", action=action)
    assert [str(each.message) for each in warned] == [told]
    assert named.notes == (told,)
    x = plain.base.sample(4, np.random.default_rng(0))
    np.testing.assert_array_equal(named.evaluate(x), plain.evaluate(x))
    rare_envs.DrivingProblem(KINEMATICS, ego="idm")  # the id's own actions need no warning
