"""The problem of HighwayEnv's environments: f, workers, egos, and p against an integral."""

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy import integrate
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import rare_envs
import samplers
from rare_envs.egos.needs import EgoWarning
from rare_envs.egos.wrappers import wrap_policy
from rare_envs.interop.problem import BarePolicy, make_highway_env
from tests.rare_envs.interop.egos import Always

FAST = {"vehicles_count": 3, "duration": 4}


IDLE = Always(1)


def fast(ego: Any = IDLE, **kwargs: Any) -> rare_envs.interop.HighwayEnvProblem:
    return rare_envs.highway_env_problem("highway-fast-v0", ego=ego, config=FAST, vehicles=2, **kwargs)


def test_f_is_the_measure_of_the_drive_that_the_wrapper_shows() -> None:
    problem = fast(Always(3))
    env = rare_envs.HighwayEnvScenario(make_highway_env("highway-fast-v0", FAST), vehicles=2)
    x = problem.base.sample(6, np.random.default_rng(0))
    x[:2, problem.space.names.index("speed")] = 5.0  # slow vehicles ahead
    f = problem.evaluate(x)
    for row, value in zip(x, f, strict=True):
        _, info = env.reset(options={"x": row})
        while "measure" not in info:
            *_, terminated, _, info = env.step(3)
        assert info["measure"] == value
        assert info["collision"] == (value == -1.0) == terminated
    assert len(set(f)) > 2
    np.testing.assert_array_equal(problem.evaluate(x[::-1])[::-1], f)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(problem)).evaluate(x[:2]), f[:2])


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


def truth_problem(**kwargs: Any) -> rare_envs.interop.HighwayEnvProblem:
    return rare_envs.highway_env_problem(
        "highway-fast-v0", ego=IDLE, config=TRUTH_CONFIG, fixed="highway_env", **kwargs
    )


def truth() -> float:
    def below(speed: float) -> float:
        spacing = (3.0 * (25.0 - speed) + 5.0) / (_FACTOR * (12.0 + speed))
        return float(np.clip((spacing - 0.9) / 0.2, 0.0, 1.0))

    return float(integrate.quad(below, 21.0, 24.0, limit=500, points=[21.1, 21.3])[0] / 3.0)


@pytest.mark.slow
def test_the_samplers_p_is_the_integral() -> None:
    p = truth()
    assert 0.005 < p < 0.03
    result = samplers.estimate(truth_problem(), gamma=0.0, seed=0, max_sim=600)
    assert result.interval[0] <= p <= result.interval[1]
    assert result.p == pytest.approx(p, rel=4 * result.cov)
    assert result.cov < 0.2


def test_what_p_is_conditional_on() -> None:
    fixed = fast(noise="fixed")
    assert fast().given == "" and "one fixed draw" in fixed.given
    assert fixed.dim == fast().dim - 1


def test_bad_input_is_refused_at_the_door() -> None:
    wide = make_highway_env("highway-fast-v0", {**FAST, "observation": {"type": "Kinematics", "vehicles_count": 7}})
    model = Always(1)
    model.observation_space = wide.observation_space  # type: ignore[attr-defined]
    cases: list[tuple[Any, dict[str, Any], str]] = [
        (model, {}, "made for observations .* config that the ego was trained with"),
        (Always, {}, "got the class Always"),
        ("dqn.zip", {}, "agents.load_ego"),
        (3, {}, "got int"),
        (lambda: 3, {}, "got int from <function"),
        (lambda observation: 1, {}, "a function without arguments that makes one, got .* which fails: TypeError"),
        (IDLE, {"horizon": -1.0}, "horizon in seconds"),
        (IDLE, {"horizon": 0.4}, "horizon of one decision of HighwayEnv or more, got 0.4 s"),
    ]
    for ego, kwargs, message in cases:
        with pytest.raises(ValueError, match=message):
            fast(ego, **kwargs)
    configs: list[tuple[dict[str, Any], str]] = [
        ({"vehicle_count": 3}, "did you mean 'vehicles_count'"),
        ({"observation": "Kinematics"}, "HighwayEnv makes no highway-fast-v0 of the config .*: TypeError"),
        ({"manual_control": True}, "would not carry out the actions"),
        *(
            ({"policy_frequency": n}, f"as a multiple of policy_frequency, both above 0, got 5 and {n}")
            for n in (6, 2, -1)
        ),
    ]
    for config, message in configs:
        with pytest.raises(ValueError, match=message):
            rare_envs.highway_env_problem("highway-fast-v0", ego="idm", config=config)
    with pytest.raises(ValueError, match="key of the config of merge-v0 'duration'"):  # it ends at a place
        rare_envs.highway_env_problem("merge-v0", ego="idm", config={"duration": 5})
    problem = fast(Always(np.nan))
    x = problem.base.sample(1, np.random.default_rng(0))
    with pytest.raises(ValueError, match="not finite"):
        problem.evaluate(x)
    with pytest.raises(ValueError, match="gave NaN"):
        fast(measure=lambda env: np.nan).evaluate(x)
    with pytest.raises(ValueError, match=r"gap\[0\] = 400"):
        problem.evaluate(np.where(np.arange(problem.dim) == 4, 400.0, x))


def test_actions_with_bounds_of_their_own_are_mapped_with_a_warning() -> None:
    ego, config = Always([0.0, 0.0]), {**FAST, "action": {"type": "ContinuousAction"}}
    ego.action_space = gym.spaces.Box(-0.5, 0.5, (2,))  # type: ignore[attr-defined]
    with pytest.warns(EgoWarning, match=r"between \[-0.5, -0.5\] and \[0.5, 0.5\], are mapped to \[-1, 1\]"):
        rare_envs.highway_env_problem("highway-fast-v0", ego, config=config)


def test_a_model_of_stable_baselines3_travels_without_its_environment() -> None:
    vec_env = VecNormalize(DummyVecEnv([lambda: make_highway_env("highway-fast-v0", FAST)]))
    model = DQN("MlpPolicy", vec_env, seed=0, buffer_size=10, policy_kwargs={"net_arch": [8]})
    vec_env.obs_rms.mean[...] = 0.5  # type: ignore[union-attr]
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 5, 5)).astype(np.float32)
    expected = model.predict(np.asarray(vec_env.normalize_obs(seen)), deterministic=True)[0]
    there = wrap_policy(pickle.loads(pickle.dumps(BarePolicy(model))), vec_env.observation_space)
    assert there.normalise(seen)[0, 0, 0] == pytest.approx(vec_env.normalize_obs(seen)[0, 0, 0])  # type: ignore[call-overload]
    np.testing.assert_array_equal(there.predict(seen)[0], expected)
    problem = fast(model)
    x = problem.base.sample(1, np.random.default_rng(2))
    scenario = rare_envs.HighwayEnvScenario(make_highway_env("highway-fast-v0", FAST), vehicles=2)
    observation, info = scenario.reset(options={"x": x[0]})
    while "measure" not in info:
        action = model.predict(np.asarray(vec_env.normalize_obs(observation)), deterministic=True)[0]
        observation, *_, info = scenario.step(action)
    assert info["measure"] == problem.evaluate(x)[0]
