"""The ego that sees: its network, its memory, its file, and that it is shown what it needs wherever it is named."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from agents import load_ego
from agents.vision.checkpoint import load_vision
from agents.vision.ego import LAG, SPEED_SCALE, VisionEgo, to_actions, update_memory
from agents.vision.pilotnet import HEIGHT, WIDTH, luma
from rare_envs.study.arguments import Question
from rare_envs.study.ego_check.subprocess_check import check_ego

CUT_IN = "rare_envs/CutIn-v0"


@pytest.fixture(scope="module")
def ego() -> VisionEgo:
    return load_vision()


def pictures(n: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (n, HEIGHT, WIDTH, 3), dtype=np.uint8))


def seen(n: int, seed: int = 0) -> dict[str, Any]:
    speed = np.random.default_rng(seed).uniform(0.0, 1.0, (n, 1)).astype(np.float32)
    return {"camera": pictures(n, seed).numpy(), "speed": speed}


def test_a_row_does_not_depend_on_the_others(ego: VisionEgo) -> None:
    observation = seen(5)
    state = np.random.default_rng(1).integers(0, 256, (5, LAG, HEIGHT, WIDTH), dtype=np.uint8)
    together, after = ego.predict(observation, state)
    for row in range(5):
        alone, mine = ego.predict({name: part[row : row + 1] for name, part in observation.items()}, state[[row]])
        np.testing.assert_allclose(alone[0], together[row], atol=1e-5)
        assert np.array_equal(mine[0], after[row])


def test_the_memory_is_of_the_last_pictures_row_by_row() -> None:
    shots = [pictures(2, seed) for seed in range(9)]
    state: Any = None
    for tick, shot in enumerate(shots):
        start = np.array([tick == 0, tick in (0, 4)])
        earlier, state = update_memory(shot, state, start)
        assert np.array_equal(earlier[0], luma(shots[max(tick - LAG, 0)])[0])
        assert np.array_equal(earlier[1], luma(shots[max(tick - LAG, 0 if tick < 4 else 4)])[1])
    assert state.shape == (2, LAG, HEIGHT, WIDTH)


def test_who_begins_anew_decides_as_one_that_begins(ego: VisionEgo) -> None:
    _, state = ego.predict(seen(3, 1))
    again, after = ego.predict(seen(3, 2), state, np.array([False, True, False]))
    first, fresh = ego.predict(seen(3, 2))
    np.testing.assert_allclose(again[1], first[1], atol=1e-6)
    assert np.array_equal(after[1], fresh[1])
    assert np.abs(again[[0, 2]] - first[[0, 2]]).max() > 1e-4


def test_actions_have_the_units_of_the_environment() -> None:
    """An acceleration of 1 is 5 m/s^2; a steady turn on a circle of radius R steers by about length / R."""
    speed, radius = 20.0, 200.0
    turn = speed / radius  # rad/s
    action = to_actions(torch.tensor([[1.0, turn / 0.1]]), torch.tensor([speed]))[0]
    assert action[0] == pytest.approx(2.0 / 5.0)
    assert action[1] * 0.1 == pytest.approx(5.0 / radius, rel=1e-3)


def test_observations_of_another_form_are_refused(ego: VisionEgo) -> None:
    with pytest.raises(ValueError, match='observation="camera\\+speed"'):
        ego.predict(np.zeros((2, 7), np.float32))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="uint8"):
        ego.predict({**seen(2), "camera": np.zeros((2, HEIGHT, WIDTH, 3), np.float32)})
    with pytest.raises(ValueError, match="speed"):
        ego.predict({**seen(2), "speed": np.zeros((3, 1), np.float32)})


def test_a_problem_shows_it_what_it_needs_and_is_a_loop_over_an_environment(ego: VisionEgo) -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=load_ego("vision"), horizon=1.5)
    x = problem.base.sample(2, np.random.default_rng(4))
    env = gym.make(CUT_IN, observation="camera+speed", horizon=1.5)
    for row, f in zip(x, problem.evaluate(x), strict=True):
        observation, info = env.reset(options={"x": row})
        state: Any = None
        done = False
        while not done:
            batch = {name: part[None] for name, part in observation.items()}
            action, state = ego.predict(batch, state, np.array([state is None]))
            observation, _, terminated, truncated, info = env.step(action[0])
            done = terminated or truncated
        assert info["measure"] == pytest.approx(f, abs=1e-3)
    env.close()


def test_it_is_shown_its_own_speed_and_nothing_else_beside_the_picture() -> None:
    env = gym.make(CUT_IN, observation="camera+speed")
    observation, _ = env.reset(seed=0, options={"ego_speed": 12.0})
    assert {name: part.shape for name, part in observation.items()} == {"camera": (HEIGHT, WIDTH, 3), "speed": (1,)}
    assert observation["speed"][0] * SPEED_SCALE == pytest.approx(12.0)
    env.close()


@pytest.mark.parametrize("spec", ["noisy:vision", "process:vision"])
def test_it_drives_behind_a_stack_and_in_a_process_of_its_own(spec: str) -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=load_ego(spec), horizon=0.3)
    assert problem.world.sensing.observation == "camera+speed"
    x = problem.base.sample(2, np.random.default_rng(4))
    f = problem.evaluate(x)
    assert np.isfinite(f).all()
    if spec == "process:vision":
        plain = rare_envs.DrivingProblem(CUT_IN, ego=load_ego("vision"), horizon=0.3)
        np.testing.assert_allclose(f, plain.evaluate(x), atol=1e-6)


def test_check_ego_finds_nothing_wrong_with_it() -> None:
    findings = check_ego(Question(env_id=CUT_IN, ego="vision", horizon=0.5))
    assert {finding.check for finding in findings} >= {"memory", "latency", "driving"}
    assert {finding.status for finding in findings if finding.check != "latency"} == {"pass"}


def test_another_observation_is_refused_with_the_right_one_named() -> None:
    with pytest.raises(ValueError, match="choose observation='camera\\+speed'"):
        rare_envs.DrivingProblem(CUT_IN, ego=load_ego("vision"), observation="features")


def test_another_tick_is_refused():
    with pytest.raises(ValueError, match=r"Expected dt=0.1 s"):
        rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=load_ego("vision"), dt=0.05)
