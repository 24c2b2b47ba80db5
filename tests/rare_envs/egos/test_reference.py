"""Reference drivers: their dangers and their braking on paper, and in every scenario the same whatever the batch."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import agents
import rare_envs
import samplers
from rare_envs.egos.reference import REFERENCE_EGOS, Scene
from rare_envs.simulation.world import World

EGOS = tuple(REFERENCE_EGOS)


def problem(name: str, ego: Any, **kwargs: Any) -> rare_envs.DrivingProblem:
    return rare_envs.DrivingProblem(f"rare_envs/{name}", ego=ego, **kwargs)


def without_cruise(name: str, **settings: Any) -> Any:
    """A reference driver as the Regulation has it: between dangers it keeps its speed."""
    ego = REFERENCE_EGOS[name]
    return replace(ego, model=replace(ego.model, cruise=False, **settings))


def drive_one(world: World, ego: Any, x: list[float]) -> tuple[list[float], list[float], list[float]]:
    """Accelerations of the ego, gaps to the first vehicle, and its distance from the ego's lane, tick by tick."""
    driver, memory, episode = ego.in_world(world), None, world.start(torch.tensor([x], dtype=torch.float64))
    found: tuple[list[float], list[float], list[float]] = ([], [], [])
    for _ in range(world.clock.ticks):
        action, memory = driver.act(episode, memory)
        state = episode.state
        numbers = (action[0, 0], state.x[0, 1] - state.x[0, 0] - 5.0, state.y[0, 1].abs())
        for each, number in zip(found, numbers, strict=True):
            each.append(float(number))
        episode = world.step(episode, action)
    return found


def see(gap: float, speed: float, lead: float, acceleration: float = 0.0, **others: float) -> Scene:
    """One driver behind one vehicle in its lane."""
    values = {"beside": -2.0, "offset": 0.0, "inward": 0.0, "braking": 0.0, **others}
    numbers = {name: torch.tensor([[number]], dtype=torch.float64) for name, number in values.items()}
    own = torch.tensor([[speed]], dtype=torch.float64), torch.tensor([[acceleration]], dtype=torch.float64)
    one = torch.tensor([[1.0]], dtype=torch.float64)
    return Scene(
        gap * one, speed=lead * one, own_speed=own[0], own_acceleration=own[1], lane_width=4.0, dt=0.1, **numbers
    )


def test_a_careful_human_evaluates_lifts_the_foot_and_brakes_with_limited_jerk() -> None:
    """20 m/s behind 10 m/s: TTC <= 2 s after tick 4 (19.5 m), 0.4 s, then 8 ticks, then 1.265 m/s^2 more each."""
    decided, _, _ = drive_one(problem("CarFollowing-v0", "idm").world, without_cruise("cc_human"), [20.0, 10.0, 24.5])
    assert decided[:8] == [0.0] * 8
    assert decided[8:16] == pytest.approx([-0.4] * 8)
    assert decided[16:22] == pytest.approx([-1.665, -2.93, -4.195, -5.46, -6.725, -0.774 * 9.80665])


def test_a_careful_human_perceives_a_cutter_beyond_the_wandering_zone() -> None:
    """At TTC 1.5 s: 4 ticks after its centre is 0.375 m off its lane's centre the foot is lifted, 8 later it brakes."""
    world = problem("CutIn-v0", "idm").world
    decided, _, offsets = drive_one(world, without_cruise("cc_human"), [20.0, 12.0, 20.0, 12.0, 60.0, 4.0])
    moved = [2.0 * now - before for before, now in zip(offsets[:1] + offsets, offsets, strict=False)]  # after the tick
    first = next(tick for tick, offset in enumerate(moved) if offset < 4.0 - 0.375)
    assert decided[: first + 4] == [0.0] * (first + 4)
    assert decided[first + 4 : first + 12] == pytest.approx([-0.4] * 8)
    assert decided[first + 12] == pytest.approx(-1.665)


def test_a_careful_human_answers_a_lead_that_brakes_hard_and_near() -> None:
    """5 m/s^2 or more within a headway of 2 s."""
    human = REFERENCE_EGOS["cc_human"].model
    seen = {(braking, gap): see(gap, 20.0, 20.0, braking=braking) for braking in (4.9, 5.0) for gap in (39.0, 41.0)}
    wanted = {key: bool(human.wanted(scene) > 0.0) for key, scene in seen.items()}
    assert wanted == {(4.9, 39.0): False, (4.9, 41.0): False, (5.0, 39.0): True, (5.0, 41.0): False}


def test_alks_stops_closing_just_before_the_lead() -> None:
    """Closing at 5 m/s it is a danger from 5 (5/12 + 0.35 + 0.05) = 4.08 m on, so at 4 m, after tick 23.

    7 ticks later, at 2.5 m, it brakes by 6 m/s^2: the way until the speeds are equal is 0.05 (17 * 5 - 0.3 * 136), 2.21
    m. Shortly before, the time to collision is no danger any more, and it comes nearer slowly.
    """
    world = problem("CarFollowing-v0", "idm", dt=0.05).world
    decided, gaps, _ = drive_one(world, without_cruise("alks"), [20.0, 15.0, 10.0])
    assert decided[:30] == [0.0] * 30
    assert decided[30] == pytest.approx(-6.0)
    assert 0.0 < min(gaps) < 2.5 - 2.21


def test_alks_notices_a_body_that_is_0_3_m_inside_the_lane() -> None:
    """In a lane of 4 m a body of 2 m is so when its centre is nearer than 2.7 m."""
    alks = REFERENCE_EGOS["alks"].model
    assert [bool(alks.notices(see(5.0, 20.0, 10.0, offset=offset))) for offset in (2.71, 2.69)] == [False, True]


def test_rss_keeps_its_safe_distances() -> None:
    """At 20 m/s both: 15 + 0.844 + 22.25^2 / 12 - 400 / 12 = 23.77 m; across at 0 and 1 m/s: 0.8625 and 2.8625 m."""
    rss = REFERENCE_EGOS["rss"].model
    assert [float(rss.wanted(see(gap, 20.0, 20.0))) for gap in (23.77, 23.76)] == [0.0, pytest.approx(7.59, abs=0.01)]
    across = [(0.0, 0.87), (0.0, 0.86), (1.0, 2.87), (1.0, 2.86), (-1.0, 0.87)]
    found = [bool(rss.notices(see(9.0, 20.0, 9.0, inward=speed, beside=side))) for speed, side in across]
    assert found == [False, True, False, True, False]


@pytest.mark.parametrize(
    ("gap", "acceleration", "braking"),
    [
        (2.0 + 59.8572, 0.0, 0.0),  # safe: 15 + 400/8 - 100/14 + 2 and 2 m more
        (2.0 + 50.5238, 0.0, 2.0),  # half-way to what is not: 15 + 400/12 - 100/14
        (2.0 + 41.0, 0.0, 4.0),
        (17.9167, 0.0, 5.0),  # half-way from 7.5 + 100/8 to 7.5 + 100/12
        (15.0, 0.0, 6.0),
        (12.51, -4.0, 4.0),  # safe while braking: (10 - 1.5) 0.75 + 49/8 = 12.5
        (11.0, -9.0, 5.1837),  # of its own braking no more than 4 counts: 4 + 2 (12.5 - 11) / (12.5 - 10.4583), or 5.47
    ],
)
def test_the_fuzzy_safety_model_brakes_softly_before_it_brakes_hard(
    gap: float, acceleration: float, braking: float
) -> None:
    """20 m/s behind 10 m/s."""
    found = REFERENCE_EGOS["fsm"].model.wanted(see(gap, 20.0, 10.0, acceleration))
    expected = braking if gap != 11.0 else 4.0 + 2.0 * 1.5 / (49.0 / 8.0 - 49.0 / 12.0)
    assert float(found) == pytest.approx(expected, abs=1e-3)


def test_the_fuzzy_safety_model_notices_who_comes_in_before_it_has_passed() -> None:
    """Closing at 10 m/s over 5 + 10 m it has passed after 1.5 s; a tick is added."""
    fsm = REFERENCE_EGOS["fsm"].model
    seen = [see(5.0, 20.0, 10.0, inward=1.0, beside=side) for side in (1.59, 1.61)]
    assert [bool(fsm.notices(scene)) for scene in seen] == [True, False]
    assert not bool(fsm.notices(see(5.0, 10.0, 20.0, inward=1.0, beside=0.1)))  # which pulls away


@pytest.mark.parametrize("ego", EGOS)
@pytest.mark.parametrize("name", ["CarFollowing-v0", "CutIn-v0", "CutIn-v1", "HardBrake-v0", "Highway-v0"])
def test_they_drive_in_every_scenario_and_a_row_does_not_depend_on_its_batch(ego: str, name: str) -> None:
    ours = problem(name, ego, horizon=1.0)
    x = ours.base.sample(6, np.random.default_rng(0))
    f = ours.evaluate(x)
    assert ours.dim == problem(name, "idm", horizon=1.0).dim
    np.testing.assert_array_equal(f, pickle.loads(pickle.dumps(ours)).evaluate(x))
    one = np.concatenate([ours.evaluate(row[None]) for row in x])
    np.testing.assert_allclose(one, f, rtol=0.0, atol=1e-9 if name != "Highway-v0" else 1e-4)


def test_between_dangers_they_follow_at_a_headway_of_two_seconds() -> None:
    """Behind a slower lead, of which they never come near: s0 + T v is 2 + 2 * 15 m."""
    world = problem("CarFollowing-v0", "idm", horizon=40.0).world
    decided, gaps, _ = drive_one(world, REFERENCE_EGOS["cc_human"], [20.0, 15.0, 80.0])
    assert min(decided) > -1.5
    assert 25.0 < min(gaps)
    assert gaps[-1] == pytest.approx(2.0 + 2.0 * 15.0, rel=0.2)


def test_settings_stand_behind_the_name() -> None:
    careless = agents.load_ego("cc_human?critical_ttc=1&cruise=0")
    assert careless == without_cruise("cc_human", critical_ttc=1.0)
    with pytest.raises(ValueError, match="did you mean 'critical_ttc'"):
        agents.load_ego("cc_human?critical_tc=1")
    with pytest.raises(ValueError, match="Expected reaction_time of the reference driver"):
        without_cruise("rss", reaction_time=float("inf"))


@pytest.mark.slow
def test_workers_drive_them_too() -> None:
    cut_in = problem("CutIn-v0", "cc_human")
    alone, both = (samplers.estimate(cut_in, "mc", 0.0, max_sim=9000, seed=0, workers=n) for n in (1, 2))
    assert alone.p == both.p > 0.0
