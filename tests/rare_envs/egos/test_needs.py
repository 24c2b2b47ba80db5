"""Needs of egos: what an ego is, what it observes and how its actions are taken."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from gymnasium import spaces

import rare_envs
from rare_envs.egos.needs import (
    EgoNeeds,
    EgoWarning,
    choose_action,
    choose_observation,
    find_fitting_kinds,
    name_ambiguities,
    resolve,
    takes_indices,
)
from rare_envs.simulation.observation import observation_space
from tests.rare_envs.interop.egos import Always

CUT_IN = "rare_envs/CutIn-v0"


class Declared:
    """A policy with the attributes that it is given."""

    def __init__(self, **attributes: Any) -> None:
        self.__dict__.update(attributes)

    def predict(self, observation: Any, **_: Any) -> Any:
        chooses = isinstance(getattr(self, "action_space", None), spaces.Discrete)
        return (np.ones(len(observation), np.int64) if chooses else np.zeros((len(observation), 2))), None


def test_a_wrapped_ego_needs_what_the_one_behind_it_needs_and_its_own_noise() -> None:
    class Behind:
        ego: ClassVar[Any] = Declared(observation_space=observation_space(3, "lidar"), dt=0.2, deterministic=False)

        def noise_columns(self, world: Any) -> int:
            return 7 * world.clock.ticks

        def in_world(self, world: Any) -> Any:
            raise AssertionError("An ego is not driven to find its needs.")

    needs = resolve(Behind(), vehicles=3)
    assert (needs.observation, needs.dt, needs.varies, needs.queries_policy) == ("lidar", 0.2, True, True)
    assert needs.noise_columns(rare_envs.DrivingProblem(CUT_IN, horizon=0.5).world) == 35


KINEMATICS = "rare_envs/CutIn-kinematics-v0"


def idle(observed: Any = None, acted: Any = None) -> Declared:
    """A policy with these spaces."""
    return Declared(observation_space=observed, action_space=acted)


@pytest.mark.parametrize(
    ("space", "fitting"),
    [
        (observation_space(3, "lidar"), ("lidar",)),
        (spaces.Box(-5, 5, (44,)), ("features",)),  # four frames side by side
        (spaces.Box(-5, 5, (4, 51)), ("lidar",)),
        (spaces.Box(0, 255, (12, 40, 80), np.uint8), ("camera",)),  # four frames of another size, channels first
        (spaces.Box(0, 255, (4, 3, 84, 84), np.uint8), ("camera",)),  # four frames on an axis of their own
        (spaces.Box(0, 255, (4, 128, 64), np.uint8), ()),  # HighwayEnv's grayscale
        (spaces.Box(-1, 1, (7, 11, 11)), ()),  # its occupancy grid
        (spaces.Dict({"radar": spaces.Box(0, 1, (3,))}), ()),
        ("Box", ()),
    ],
)
def test_what_it_observes_is_read_from_its_space(space: Any, fitting: tuple[str, ...]) -> None:
    assert find_fitting_kinds(space, vehicles=3) == fitting


def test_several_or_none_are_refused_in_a_line() -> None:
    both = find_fitting_kinds(observation_space(13, "lidar"), vehicles=13)
    with pytest.raises(ValueError, match="fit features and lidar: say which"):
        choose_observation(EgoNeeds(observations=both), vehicles=13)
    grayscale, grid = spaces.Box(0, 255, (4, 84, 84), np.uint8), spaces.Box(-1, 1, (7, 11, 11))
    for space, elsewhere in ((spaces.Box(-1, 1, (97,)), False), (grayscale, True), (grid, True)):
        with pytest.raises(ValueError, match=r"features \(11,\), lidar \(51,\), kinematics \(5, 5\)") as refused:
            rare_envs.DrivingProblem(CUT_IN, ego=idle(space))
        assert ("rare_envs.highway_env_problem" in str(refused.value)) == elsewhere
        assert "\n" not in str(refused.value)


def test_actions_may_be_a_view_backwards() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=lambda seen: np.zeros((len(seen), 2))[::-1])
    assert np.isfinite(problem.evaluate(problem.base.sample(2, np.random.default_rng(0)))).all()


@pytest.mark.parametrize("space", [spaces.Discrete(7), spaces.Discrete(5, start=1)])
def test_other_numbers_than_0_to_4_are_refused(space: spaces.Discrete) -> None:
    with pytest.raises(ValueError, match=r"^The ego acts in Discrete\(.*or Discrete\(5\); put an object"):
        rare_envs.DrivingProblem(CUT_IN, ego=idle(observation_space(3), space))


@pytest.mark.parametrize("shape", [(64, 80, 3), (12, 64, 80)])
@pytest.mark.parametrize("named", [False, True])
def test_pictures_of_another_size_are_refused_by_both_sizes_and_a_camera_gives_them(
    shape: tuple[int, ...], named: bool
) -> None:
    space: spaces.Space[Any] = spaces.Box(0, 255, shape, np.uint8)
    ego = idle(spaces.Dict({"camera": space, "speed": observation_space(3, "speed")}) if named else space)
    words = r"^The ego.*; the camera gives 66 x 200 pixels, in Python camera=\(64, 80\) .* module:function, .* resizes"
    with pytest.raises(ValueError, match=words):
        rare_envs.DrivingProblem(CUT_IN, ego=ego)
    if not named or shape[-1] == 3:
        rare_envs.DrivingProblem(CUT_IN, ego=ego, camera=(64, 80))


def test_a_policy_of_highway_env_says_by_its_id_or_by_hand_what_its_actions_are() -> None:
    ego = idle(observation_space(3, "kinematics"), spaces.Discrete(5))
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
    steering = idle(observation_space(3, "kinematics"), spaces.Box(-1.0, 1.0, (2,)))
    for make in (rare_envs.DrivingProblem, partial(rare_envs.parallel_env, observation="kinematics")):
        with pytest.raises(ValueError, match=r"fit two kinds: acceleration .*--action continuous.* ContinuousAction"):
            make(CUT_IN, ego=steering)
        assert make(CUT_IN, ego=steering, action="continuous").world.clock.action == "continuous"


def test_other_policies_are_taken_to_accelerate() -> None:
    for acted, indices in ((spaces.Discrete(5), True), (spaces.Discrete(3), False), (None, False)):
        assert takes_indices(acted) is indices
        assert choose_action(acted, "lidar") == "continuous"
    problem = rare_envs.DrivingProblem(CUT_IN, ego=idle(observation_space(3, "features"), spaces.Discrete(5)))
    assert len(problem.notes) == 1 and "--action meta" in problem.notes[0]  # and no warning
    x = problem.base.sample(4, np.random.default_rng(0))
    said = rare_envs.DrivingProblem(CUT_IN, ego=problem.ego, action="discrete")
    np.testing.assert_array_equal(problem.evaluate(x), said.evaluate(x))


@pytest.mark.parametrize("action", ["meta", "discrete"])
def test_an_ego_that_drives_itself_says_that_named_actions_change_nothing(action: str) -> None:
    told = f"the ego accelerates and steers by itself: action='{action}' (--action {action}) changes nothing for it"
    plain = rare_envs.DrivingProblem(CUT_IN, ego="imitation")
    assert plain.notes == ()
    with pytest.warns(EgoWarning) as warned:
        named = rare_envs.DrivingProblem(CUT_IN, ego="imitation", action=action)
    assert [str(each.message) for each in warned] == [told]
    assert named.notes == (told,)
    x = plain.base.sample(4, np.random.default_rng(0))
    np.testing.assert_array_equal(named.evaluate(x), plain.evaluate(x))
    rare_envs.DrivingProblem(KINEMATICS, ego="idm")  # the id's own actions need no warning


def test_other_bounds_are_told_as_people_write_them():
    (note,) = name_ambiguities(spaces.Box(np.float32([-0.3, -4.0]), np.float32([0.1, 2.0])), ("features",))
    assert note.startswith("the ego's actions, between [-0.3, -4.0] and [0.1, 2.0], are mapped to [-1, 1]")


X = [[20.0, 15.0, 30.0], [30.0, 5.0, 20.0], [25.0, 24.0, 60.0]]


def brake(observation):
    return np.tile(np.array([-0.4, 0.0], dtype=np.float32), (len(observation), 1))


class BrakingNetwork(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.bias = torch.nn.Parameter(torch.tensor([-0.4, 0.0], dtype=torch.float64))
        self.dropout = torch.nn.Dropout(0.5)

    def forward(self, observation):
        assert observation.dtype == self.bias.dtype
        return self.dropout(self.bias.expand(len(observation), 2))


@pytest.mark.parametrize("ego", [brake, BrakingNetwork(), lambda observation: brake(observation).tolist()])
def test_functions_and_networks_drive_as_the_policy_does(ego):
    wanted = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Always([-0.4, 0.0])).evaluate(X)
    np.testing.assert_array_equal(rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego).evaluate(X), wanted)
