"""From moments to f: what is kept of an episode, wherever it is driven, and what is refused."""

from collections.abc import Callable

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.measures import (
    minimum,
    stl,
    with_collision,
)
from rare_envs.measures.registry import MEASURES
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.world import World
from tests.rare_envs.measures.moments import AWAY, CLOSE, CUT_IN, FOLLOWING, HIT, problem


@pytest.mark.parametrize(
    ("name", "collision"),
    [
        *((name, -1.0) for name in ("ttc", "mttc", "pet", "clearance", "thw", "ttc_2d")),
        *((name, -100.0) for name in ("drac", "btn", "required_deceleration")),
        *(("ttb", -10.0), ("rss_margin", -1000.0)),
    ],
)
def test_a_collision_is_worse_than_anything_else(name: str, collision: float) -> None:
    values = problem(name).evaluate(np.array([HIT, CLOSE, AWAY]))
    assert values[0] == collision
    assert values[1] < values[2]
    assert values[0] < values[1]


def test_near_crashes_count_collisions_apart() -> None:
    """IDM brakes by 5 m/s^2 at most, which is more than 0.5 g; with a hit it is too late."""
    around = rare_envs.DrivingProblem(FOLLOWING, measure="near_crash")
    f = around.evaluate(np.array([(30.0, 10.0, 5.0), (30.0, 10.0, 60.0), (20.0, 20.0, 100.0)]))
    assert f[0] == -100.0
    assert f[1] == pytest.approx(1.0 - 5.0 / (0.5 * 9.80665), abs=1e-4)
    assert 0.99 < f[2] < 1.0


def test_margin_goes_on_past_contact() -> None:
    hits = problem("margin").evaluate(np.array([[20.0, 15.0, 20.2], [20.0, 10.0, 60.5], [30.0, 10.0, 60.5]]))
    assert hits == pytest.approx([-5.0, -10.0, -20.0])
    near = problem("margin").evaluate(np.array([[20.0, 10.0, 100.2], [20.0, 10.0, 101.0]]))
    assert 0.0 < near[0] < near[1] < 0.2


SAMPLE: dict[str, Callable[[], object]] = {
    **{name: (lambda name=name: name) for name in ("drac", "ttb", "tet", "pet", "margin", "rss_margin", "ttc_2d")},
    "minimum": lambda: minimum("ttc", "pet", with_collision("drac", -3.0)),
    "stl": lambda: stl("always (gap > 2 or ttc > 1)"),
    "function": lambda: lambda moment: moment.lead.gap.clamp(max=99.0),
}


@pytest.mark.parametrize("name", SAMPLE)
def test_same_value_alone_in_a_batch_and_in_a_problem(name: str) -> None:
    if name == "stl":
        pytest.importorskip("rtamt", reason="rtamt runs on Python 3.11 or older")
    measure, kwargs = SAMPLE[name](), {"horizon": 2.0}
    whole = problem(measure, CUT_IN, **kwargs)
    # half of them collide, at different times
    x = whole.base.sample(6, np.random.default_rng(2))
    x[:3, 3], x[:3, 0], x[:3, 1] = (2.0, 6.0, 12.0), 32.0, 15.0
    expected = whole.evaluate(x)
    batch = gym.make_vec(CUT_IN, 6, vectorization_mode="vector_entry_point", measure=measure, **kwargs)
    batch.reset(seed=1, options={"x": x})
    ends: list[tuple[np.ndarray, float]] = []
    for _ in range(60):  # on through the episodes that follow
        *_, infos = batch.step(np.zeros((6, 2), dtype=np.float32))
        for row in np.flatnonzero(infos.get("_final_info", [])):
            ends.append((infos["final_info"]["x"][row], infos["final_info"]["measure"][row]))
    assert len(ends) > 12
    found = whole.evaluate(np.array([end[0] for end in ends]))
    np.testing.assert_array_equal([end[1] for end in ends], found)
    env = gym.make(CUT_IN, measure=measure, **kwargs)
    for point, value in zip(x[1:4], expected[1:4], strict=True):
        env.reset(options={"x": point})
        while True:
            *_, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
            if terminated or truncated:
                break
        assert info["measure"] == value


def test_min_ttc_is_one_whatever_the_measure() -> None:
    found = []
    for measure in ("ttc", "drac"):
        env = gym.make(FOLLOWING, measure=measure)
        env.reset(options=dict(zip(("ego_speed", "lead_speed", "gap"), CLOSE, strict=True)))
        found.append([env.step(np.zeros(2, dtype=np.float32))[4]["min_ttc"] for _ in range(20)])
    assert found[0] == found[1]
    assert found[0][-1] == pytest.approx(8.05, abs=1e-3)


def test_every_measure_serves_a_world() -> None:
    x = torch.tensor([HIT, CLOSE, AWAY])
    for name in MEASURES:
        world = World(problem("ttc").world.scenario, measurement=Measurement(name), clock=Clock(horizon=1.0))
        episode = world.start(x)
        for _ in range(world.clock.ticks):
            episode = world.step(episode, torch.zeros(3, 2))
        assert episode.f.shape == (3,)
        assert torch.isfinite(episode.f).all()
