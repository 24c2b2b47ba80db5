"""DrivingProblem: egos, their spaces, and what is refused before a simulation."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import rare_envs
import samplers
from rare_envs.problem import POLICY_TILE


class Constant:
    """An ego that always does the same, and notes the batches it is asked about."""

    def __init__(self, action: Any, **attributes: Any) -> None:
        self.action = np.asarray(action)
        self.batches: list[int] = []
        self.__dict__.update(attributes)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        assert deterministic
        self.batches.append(len(observation))
        return np.repeat(self.action[None], len(observation), axis=0), state


def test_fits_the_protocol_of_samplers() -> None:
    problem: samplers.Problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0")
    assert problem.dim == 3
    x = problem.base.sample(50, np.random.default_rng(0))
    f = problem.evaluate(x)
    assert f.dtype == np.float64
    assert ((f == -1.0) | ((f > 0.0) & (f <= 10.0))).all()


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


def test_discrete_egos_use_the_table() -> None:
    x = np.array([[20.0, 10.0, 30.0]])
    discrete = Constant(np.int64(0), action_space=spaces.Discrete(5))
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=discrete)
    brakes = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Constant([-1.0, 0.0]))
    assert problem.evaluate(x) == brakes.evaluate(x)


def test_policies_are_asked_in_fixed_tiles() -> None:
    ego = Constant([-1.0, 0.0])
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego, horizon=0.1)
    problem.evaluate(problem.base.sample(POLICY_TILE + 10, np.random.default_rng(0)))
    assert ego.batches == [POLICY_TILE, 10]


def test_no_rows() -> None:
    assert rare_envs.DrivingProblem("rare_envs/CutIn-v0").evaluate(np.empty((0, 6))).shape == (0,)


def test_recurrent_egos_get_their_state_back() -> None:
    seen: list[tuple[Any, bool]] = []

    class Recurrent(Constant):
        def predict(
            self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
        ) -> Any:
            seen.append((state, bool(episode_start.all())))
            return super().predict(observation, None, episode_start, deterministic)[0], (len(seen),)

    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Recurrent([0.0, 0.0]), horizon=0.3)
    problem.evaluate(np.array([[20.0, 20.0, 30.0]]))
    assert seen == [(None, True), ((1,), False), ((2,), False)]


@pytest.mark.parametrize(
    ("ego", "message"),
    [
        ("imd", "Unknown ego 'imd'"),
        (object(), "predict"),
        (Constant([0.0, 0.0], observation_space=spaces.Box(-1, 1, (25,))), r"observations.*25.*11"),
        (Constant(0, action_space=spaces.Discrete(3)), r"Discrete\(3\).*Discrete\(5\)"),
        (Constant([0.0], action_space=spaces.Box(-1, 1, (1,))), "acceleration, steering"),
    ],
)
def test_wrong_egos_are_refused_before_any_simulation(ego: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=ego)


def test_nan_actions_are_an_error_with_a_count() -> None:
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Constant([np.nan, 0.0]))
    with pytest.raises(ValueError, match="NaN or infinite actions for 3 of 3 observations"):
        problem.evaluate(problem.base.sample(3, np.random.default_rng(0)))


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
