"""DrivingProblem: egos, their spaces, and what is refused before a simulation."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
import samplers
from rare_envs.devices import POLICY_TILE
from rare_envs.scenarios.registry import SCENARIOS


class Constant:
    """An ego that always does the same, and notes the batches it is asked about."""

    def __init__(self, action: Any, **attributes: Any) -> None:
        self.action = np.asarray(action)
        self.batches: list[int] = []
        self.__dict__.update(attributes)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        self.batches.append(len(observation))
        return np.repeat(self.action[None], len(observation), axis=0), state


def test_braking_and_accelerating_egos() -> None:
    x = np.array([[20.0, 10.0, 30.0], [20.0, 25.0, 30.0]])
    brakes = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Constant([-1.0, 0.0])).evaluate(x)
    throttle = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Constant([1.0, 0.0])).evaluate(x)
    # braking at 5 m/s^2 from 20 behind 10 m/s: gap and closing speed after k ticks are
    # 30 - (10 k - 0.25 k (k - 1)) / 10 and 10 - k / 2
    expected = min((30 - (10 * k - 0.25 * k * (k - 1)) / 10) / (10 - k / 2) for k in range(20))
    assert brakes[0] == pytest.approx(expected, rel=1e-5)
    assert brakes[1] == 10.0
    assert (throttle == -1.0).all()


def test_no_scenarios_have_no_outcomes() -> None:
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0")
    none = np.empty((0, 3))
    assert (problem.evaluate(none).shape, problem.crash_kinds(none)) == ((0,), [])


def test_policies_are_asked_in_fixed_tiles() -> None:
    ego = Constant([-1.0, 0.0])
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego, horizon=0.1)
    problem.evaluate(problem.base.sample(POLICY_TILE + 10, np.random.default_rng(0)))
    assert ego.batches == [POLICY_TILE, 10]


def test_wrong_x_is_refused() -> None:
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0")
    with pytest.raises(ValueError, match="shape"):
        problem.evaluate(np.zeros((4, 2)))
    with pytest.raises(ValueError, match="gap"):
        problem.evaluate(np.array([[20.0, 20.0, np.nan]]))
    with pytest.raises(ValueError, match=r"gap = 500 .*\[1, 150\] m"):
        problem.evaluate(np.array([[20.0, 20.0, 500.0]]))
    with pytest.raises(ValueError, match="noise"):
        rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", noise="some")


class RootOfGap(Constant):
    """A law in the square root of the gap, defined for every state that an episode shows before contact."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert (observation[:, 3] >= 0.0).all()
        acceleration = 0.1 * np.sqrt(observation[:, 3])
        return np.stack([acceleration, 0.0 * acceleration], axis=1), state


def test_what_comes_after_a_collision_is_not_shown_to_the_policy() -> None:
    x, ego = np.array([[25.0, 10.0, 20.0], [20.0, 20.0, 30.0]]), RootOfGap([0.0])
    f = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego).evaluate(x)
    env = gym.make("rare_envs/CarFollowing-v0")
    for row in range(2):
        observation, _ = env.reset(options={"x": x[row]})
        done = False
        while not done:
            observation, _, terminated, truncated, info = env.step(ego.predict(observation[None])[0][0])
            done = terminated or truncated
        assert info["measure"] == f[row]
    assert f[0] == -1.0 < f[1]


def test_p_is_conditional_on_fixed_noise_and_says_so() -> None:
    for noise, drivers, given in (("fixed", "mgail", True), ("fixed", None, False), (True, "mgail", False)):
        problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", drivers=drivers, noise=noise, horizon=1.0)
        result = samplers.estimate(problem, "mc", gamma=2.0, seed=0, max_sim=50)
        assert ("Given the drivers' noise is one fixed sequence" in " ".join(str(result).split())) == given


@pytest.mark.parametrize("env_id", [env_id for env_id in SCENARIOS if SCENARIOS[env_id].drivers is None])
def test_a_row_does_not_depend_on_its_batch(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id)
    x = problem.base.sample(300, np.random.default_rng(2))
    f = problem.evaluate(x)
    for n in (1, 7, 33):
        np.testing.assert_array_equal(problem.evaluate(x[:n]), f[:n])
    np.testing.assert_array_equal(problem.evaluate(x[::-1])[::-1], f)


class Fails(torch.nn.Module):
    """Goes straight on, but for the first row after some queries."""

    def __init__(self, answer: float, after: int) -> None:
        super().__init__()
        self.answer, self.left = answer, after

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        actions = torch.zeros(len(seen), 2)
        self.left -= 1
        if self.left < 0:
            if self.answer == 0.0:
                raise SystemExit(3)
            actions[0, 1] = self.answer
        return actions


def replay_as_on_a_gpu(ego: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what a problem on a GPU makes of two scenarios; the numbers stay here."""
    monkeypatch.setattr("rare_envs.control.actions.can_look", lambda _: False)
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego, core="torch")
    problem.device = torch.device("cuda")
    with torch.inference_mode():
        return problem._replay(problem.world, torch.tensor([[20.0, 25.0, 30.0], [20.0, 25.0, 40.0]]))


@pytest.mark.parametrize("answer", [0.0, np.nan, np.inf], ids=["error", "nan", "infinite"])
@pytest.mark.parametrize("after", [0, 99])
def test_a_policy_that_fails_on_a_gpu_is_queried_again(answer: float, after: int, monkeypatch: Any) -> None:
    assert replay_as_on_a_gpu(Fails(answer, after), monkeypatch) is None


def test_a_policy_of_anybody_is_queried_through_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    assert replay_as_on_a_gpu(Constant([0.0, 0.0]), monkeypatch) is None
