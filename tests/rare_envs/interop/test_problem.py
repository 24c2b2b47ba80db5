"""HighwayEnv's environments as problems: f is what the drive shows, p is the truth, workers change nothing."""

import pickle
import threading
from typing import Any

import numpy as np
import pytest
from scipy import integrate
from stable_baselines3 import DQN

import rare_envs
import samplers
from rare_envs.interop.problem import make_highway_env
from tests.rare_envs.interop.egos import Always

FAST = {"vehicles_count": 3, "duration": 4}


IDLE = Always(1)


def fast(ego: Any = IDLE, **kwargs: Any) -> rare_envs.HighwayEnvProblem:
    return rare_envs.highway_env_problem("highway-fast-v0", ego=ego, config=FAST, vehicles=2, **kwargs)


def test_f_is_the_measure_of_the_drive_that_the_wrapper_shows() -> None:
    problem = fast(Always(3))
    env = rare_envs.HighwayEnvScenario(make_highway_env("highway-fast-v0", FAST), vehicles=2)
    x = problem.base.sample(6, np.random.default_rng(0))
    x[:2, problem.space.names.index("speed")] = 5.0  # slow vehicles ahead
    f = problem.evaluate(x)
    for row, value in zip(x, f, strict=True):
        env.reset(options={"x": row})
        over = False
        while not over:
            *_, terminated, truncated, info = env.step(3)
            over = terminated or truncated
        assert info["measure"] == value
        assert info["collision"] == (value == -1.0) == terminated
    assert len(set(f)) > 2
    np.testing.assert_array_equal(problem.evaluate(x[::-1])[::-1], f)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(problem)).evaluate(x[:2]), f[:2])


@pytest.mark.parametrize("env_id", ["merge-v1", "roundabout-v1", "intersection-v2"])
def test_the_other_environments_are_functions_of_x(env_id: str) -> None:
    config = {"initial_vehicle_count": 3, "duration": 4} if env_id.startswith("inter") else None
    problem = rare_envs.highway_env_problem(env_id, ego="idm", config=config, horizon=4.0)
    x = problem.base.sample(2, np.random.default_rng(3))
    f = problem.evaluate(x)
    assert ((f == -1.0) | ((f > 0.0) & (f <= 10.0))).all()
    np.testing.assert_array_equal(problem.evaluate(x[:1]), f[:1])


# One lane, one vehicle ahead that keeps its speed v, an ego that keeps 25 m/s: after 3 s they have met exactly if the
# gap was less than 3 s x (25 m/s - v). Speed and gap have HighwayEnv's law, so p is an integral.
TRUTH_CONFIG = {
    "observation": {"type": "TimeToCollision"},
    "lanes_count": 1,
    "vehicles_count": 1,
    "vehicles_density": 1.65,
    "duration": 3,
}
_FACTOR = float(np.exp(-1 / 8)) / 1.65


def truth_problem(**kwargs: Any) -> rare_envs.HighwayEnvProblem:
    return rare_envs.highway_env_problem(
        "highway-fast-v0", ego=IDLE, config=TRUTH_CONFIG, fixed="highway_env", **kwargs
    )


def truth() -> float:
    def below(speed: float) -> float:
        spacing = (3.0 * (25.0 - speed) + 5.0) / (_FACTOR * (12.0 + speed))
        return float(np.clip((spacing - 0.9) / 0.2, 0.0, 1.0))

    return float(integrate.quad(below, 21.0, 24.0, limit=500, points=[21.1, 21.3])[0] / 3.0)


def test_collisions_are_those_of_the_formula() -> None:
    problem = truth_problem()
    assert problem.space.names == ("ego_lane", "speed", "gap", "lane", "noise")
    x = problem.base.sample(4000, np.random.default_rng(4))
    slack = x[:, 2] - 3.0 * (25.0 - x[:, 1])
    x, slack = x[np.argsort(abs(slack))[20:40]], np.sort(abs(slack))[20:40]
    hit = x[:, 2] < 3.0 * (25.0 - x[:, 1])
    assert 3 < hit.sum() < 17
    np.testing.assert_array_equal(problem.evaluate(x) == -1.0, hit)


def test_the_samplers_p_is_the_integral() -> None:
    p = truth()
    assert 0.005 < p < 0.03
    result = samplers.estimate(truth_problem(), gamma=0.0, seed=0, max_sim=600)
    assert result.interval[0] <= p <= result.interval[1]
    assert result.p == pytest.approx(p, rel=4 * result.cov)
    assert result.cov < 0.2


@pytest.mark.slow
def test_long_monte_carlo_agrees_with_the_integral_and_the_sampler() -> None:
    p, n = truth(), 6000
    f = truth_problem(workers=2).evaluate(truth_problem().base.sample(n, np.random.default_rng(5)))
    assert abs((f <= 0.0).mean() - p) < 4.0 * (p * (1.0 - p) / n) ** 0.5


def test_what_p_is_conditional_on() -> None:
    assert fast().given == ""
    fixed = fast(noise="fixed")
    assert "one fixed draw" in fixed.given
    assert fixed.dim == fast().dim - 1
    assert rare_envs.highway_env_problem("merge-v1", noise="fixed").given == ""


def test_bad_input_is_refused_at_the_door() -> None:
    wide = make_highway_env("highway-fast-v0", {**FAST, "observation": {"type": "Kinematics", "vehicles_count": 7}})
    model = DQN("MlpPolicy", wide, buffer_size=10)
    cases: list[tuple[Any, dict[str, Any], str]] = [
        (model, {}, "made for observations .* config that the ego was trained with"),
        (Always, {}, "got the class Always"),
        ("dqn.zip", {}, "agents.load_ego"),
        (3, {}, "got int"),
        (lambda: 3, {}, "got int from <function"),
        (IDLE, {"workers": 0}, "workers of at least 1"),
        (IDLE, {"horizon": -1.0}, "horizon in seconds"),
        (IDLE, {"measure": "ttcc"}, "did you mean 'ttc'"),
    ]
    for ego, kwargs, message in cases:
        with pytest.raises(ValueError, match=message):
            fast(ego, **kwargs)
    with pytest.raises(ValueError, match="did you mean 'vehicles_count'"):
        rare_envs.highway_env_problem("highway-fast-v0", ego="idm", config={"vehicle_count": 3})
    with pytest.raises(ValueError, match="merge-v0 has no 'duration'"):  # it ends at a place
        rare_envs.highway_env_problem("merge-v0", ego="idm", config={"duration": 5})
    with pytest.raises(ValueError, match="did you mean 'highway-fast-v0'"):
        rare_envs.highway_env_problem("highway-fast")
    locked = Always(1)
    locked.lock = threading.Lock()  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="give a function without arguments that makes it"):
        fast(locked, workers=2)
    problem = fast(Always(np.nan))
    with pytest.raises(ValueError, match="not finite"):
        problem.evaluate(problem.base.sample(1, np.random.default_rng(0)))
    with pytest.raises(ValueError, match=r"gap\[0\] = 400"):
        x = problem.base.sample(1, np.random.default_rng(0))
        x[0, 4] = 400.0
        problem.evaluate(x)
