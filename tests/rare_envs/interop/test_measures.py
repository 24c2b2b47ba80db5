"""Measures of HighwayEnv's scenes, by hand and against the tensor implementation."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

import rare_envs
from rare_envs.interop.problem import make_highway_env
from rare_envs.interop.scene import HIGHWAY_ENV_MEASURES, contact_time
from rare_envs.traffic.bodies import axes_of, project_on_axes, time_to_contact
from tests.rare_envs.interop.egos import Always

FAST = {"vehicles_count": 3, "duration": 4}

IDLE = Always(1)


def fast(ego: Any = IDLE, **kwargs: Any) -> rare_envs.HighwayEnvProblem:
    return rare_envs.highway_env_problem("highway-fast-v0", ego=ego, config=FAST, vehicles=2, **kwargs)


def body(rng: np.random.Generator) -> SimpleNamespace:
    heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 30.0)
    return SimpleNamespace(
        position=rng.uniform(-8.0, 8.0, 2),
        heading=heading,
        velocity=speed * np.array([np.cos(heading), np.sin(heading)]),
        LENGTH=Vehicle.LENGTH,
        WIDTH=Vehicle.WIDTH,
    )


def test_contact_time_is_that_of_the_tensor_implementation() -> None:
    rng = np.random.default_rng(6)
    pairs = [(body(rng), body(rng)) for _ in range(300)]
    ours = np.array([contact_time(one, other) for one, other in pairs])

    def column(values: list[Any]) -> torch.Tensor:
        return torch.tensor(np.array(values), dtype=torch.float64)

    way: NDArray[np.float64] = np.array([other.position - one.position for one, other in pairs])
    drift: NDArray[np.float64] = np.array([other.velocity - one.velocity for one, other in pairs])
    headings = column([one.heading for one, _ in pairs]), column([other.heading for _, other in pairs])
    axes = axes_of(column(way[:, 0]), column(way[:, 1]), *headings)  # type: ignore[arg-type]
    rate = project_on_axes(column(drift[:, 0]), column(drift[:, 1]), *headings)  # type: ignore[arg-type]
    theirs = time_to_contact(axes, rate).numpy()
    meet = ours < 10.0
    assert 20 < meet.sum() < 280
    np.testing.assert_allclose(ours[meet], theirs[meet], atol=1e-9)
    assert (theirs[~meet] >= 10.0).all()


def test_measures_by_hand() -> None:
    env = rare_envs.HighwayEnvScenario(make_highway_env("highway-fast-v0", {**FAST, "vehicles_count": 2}), vehicles=2)
    env.reset(options={"ego_lane": 0, "ego_speed": 30.0, "speed": [20.0, 10.0], "gap": [30.0, 2.0], "lane": [1, 0]})
    assert HIGHWAY_ENV_MEASURES["front_ttc"](env.scene) == pytest.approx(
        37.0 / 20.0
    )  # the second one: 30 + 5 + 2 m ahead
    assert HIGHWAY_ENV_MEASURES["ttc"](env.scene) == pytest.approx(37.0 / 20.0)  # the other lane's is passed by
    env.reset(options={"ego_lane": 0, "ego_speed": 30.0, "speed": [20.0, 10.0], "gap": [30.0, 2.0], "lane": [1, 1]})
    assert (HIGHWAY_ENV_MEASURES["front_ttc"](env.scene), HIGHWAY_ENV_MEASURES["ttc"](env.scene)) == (10.0, 10.0)


def test_a_measure_of_ones_own() -> None:
    problem = fast(measure=lambda env: 40.0 - env.vehicle.speed)
    assert (problem.evaluate(problem.base.sample(1, np.random.default_rng(0))) >= 10.0 - 1e-9).all()
    with pytest.raises(ValueError, match="gave NaN"):
        fast(measure=lambda env: np.nan).evaluate(problem.base.sample(1, np.random.default_rng(0)))
