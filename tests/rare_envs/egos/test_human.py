"""The human ego in its worlds: IDM without human limits, late by its reaction time, its randomness all in x."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import agents
import rare_envs
from rare_envs.control.human_driver import Glances, HumanDriverModel
from rare_envs.control.idm import IDM
from rare_envs.egos.human import HumanDriver, HumanEgo
from rare_envs.simulation.world import World, drive

SCENARIOS = ("CarFollowing", "CutIn", "HardBrake")
FLAWLESS = HumanDriverModel(
    idm=IDM(),
    reaction_time=0.0,
    gap_error=0.0,
    approach_error=0.0,
    leaders=1,
    wandering=1.0,  # as far as `lead_of` sees into the next lane
    noticing_time=0.0,
    jerk=math.inf,
    glances=False,
)
SURE = HumanDriverModel(gap_error=0.0, approach_error=0.0, glances=False)


def problem(name: str, ego: Any = "human", **kwargs: Any) -> rare_envs.DrivingProblem:
    return rare_envs.DrivingProblem(f"rare_envs/{name}-v0", ego=ego, **kwargs)


def accelerations(driver: HumanDriver, world: World, x: list[float]) -> list[float]:
    """What the driver decides in each tick of one scenario."""
    episode, memory, decided = world.start(torch.tensor([x], dtype=torch.float64)), None, []
    for _ in range(world.clock.ticks):
        action, memory = driver.act(episode, memory)
        decided.append(float(action[0, 0]))
        episode = world.step(episode, action)
    return decided


@pytest.mark.parametrize("name", SCENARIOS)
def test_without_human_limits_it_is_the_idm(name: str) -> None:
    flawless, idm = problem(name, HumanEgo(FLAWLESS)), problem(name, "idm")
    x = torch.from_numpy(idm.base.sample(200, np.random.default_rng(0)))
    for ours, theirs in zip(drive(flawless.world, flawless.driver, x), drive(idm.world, IDM(), x), strict=True):
        there = ~theirs.collided
        torch.testing.assert_close(ours.state.speed[there], theirs.state.speed[there], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("late", [0.0, 0.6])
def test_a_braking_lead_is_answered_one_reaction_time_later(late: float) -> None:
    """Speeds are equal until the lead brakes at 0; the first tick in which its speed differs is 0.1 s."""
    driver = HumanEgo(replace(SURE, reaction_time=late)).in_world(problem("HardBrake").world)
    x = [15.0, 40.0, 4.0]
    braking, calm = (accelerations(driver, driver.world, each) for each in (x, [15.0, 40.0, 1e-12]))
    differ = [abs(a - b) > 1e-6 for a, b in zip(braking, calm, strict=True)]
    assert differ.index(True) == round(late / 0.1) + 1


def test_a_cutter_is_answered_after_noticing_and_reacting() -> None:
    """It begins outside of the zone in which it counts and enters it in tick k: 0.4 s to notice, 0.6 s to react."""
    world = problem("CutIn").world
    x = [15.0, 12.0, 15.0, 15.0, 60.0, 4.0]
    driver = HumanDriver(SURE, world)
    blind = HumanDriver(replace(SURE, noticing_time=100.0), world)
    differ = [a != b for a, b in zip(accelerations(driver, world, x), accelerations(blind, world, x), strict=True)]
    offsets = [float(each.state.y[0, 1]) for each in drive(world, blind, torch.tensor([x], dtype=torch.float64))]
    entered = next(tick for tick, y in enumerate(offsets) if y <= 4.0 - 0.375)
    assert 0 < entered < 20
    assert differ.index(True) == entered + 4 + 6


def test_braking_builds_up_at_the_published_rate_to_the_published_maximum() -> None:
    world = problem("CarFollowing").world
    decided = accelerations(HumanDriver(SURE, world), world, [30.0, 5.0, 30.0])
    assert decided[:3] == pytest.approx([-1.265, -2.53, -3.795])
    assert min(decided) == pytest.approx(-0.774 * 9.80665)


def test_what_was_there_at_the_start_does_not_move_before_it_was_seen() -> None:
    """In the first reaction time the percept stays that of time 0, also with the eyes off the road."""
    world = problem("CarFollowing").world
    glance = Glances(torch.tensor([[0.0, 0.0]]), torch.tensor([[0.0, 3.0]]))
    driver = HumanDriver(SURE, world, glances=glance)
    episode, memory = world.start(torch.tensor([[20.0, 10.0, 80.0]], dtype=torch.float64)), None
    known = []
    for _ in range(driver.delay + 3):
        action, memory = driver.act(episode, memory)
        episode = world.step(episode, action)
        known.append(float(memory.known.distance[0, 0]))
    assert bool(memory.away)
    assert known[: driver.delay + 1] == [known[0]] * (driver.delay + 1)
    assert known[driver.delay + 1] == pytest.approx(known[0] - 0.1 * 10.0, rel=1e-6)


def test_in_a_glance_the_lead_is_taken_to_keep_its_speed() -> None:
    world = problem("HardBrake").world
    glance = Glances(torch.tensor([[0.0, 0.5]]), torch.tensor([[0.0, 2.5]]))
    model = replace(SURE, reaction_time=0.0)
    x, until = [15.0, 40.0, 4.0], 5
    away = accelerations(HumanDriver(model, world, glances=glance), world, x)
    seeing = accelerations(HumanDriver(model, world), world, x)
    assert away[:until] == seeing[:until]
    assert all(late > prompt for late, prompt in zip(away[until + 1 : 25], seeing[until + 1 : 25], strict=True))
    assert away[26] < away[24] - 1.0  # it looks back, and brakes


def test_no_glance_is_begun_in_danger_and_none_is_broken_off() -> None:
    """Closing at 10 m/s from 40 m: the share is 0.25 per second, above 0.2; from 80 m it is below at first."""
    world = problem("CarFollowing").world
    glance = Glances(torch.tensor([[0.0, 0.3]]), torch.tensor([[0.0, 4.0]]))
    for gap, looks_away in ((40.0, False), (80.0, True)):
        driver = HumanDriver(replace(SURE, reaction_time=0.0), world, glances=glance)
        episode, memory = world.start(torch.tensor([[20.0, 10.0, gap]])), None
        away = []
        for _ in range(45):
            action, memory = driver.act(episode, memory)
            episode = world.step(episode, action)
            away.append(bool(memory.away))
        assert away == [False] * 3 + [looks_away] * 37 + [False] * 5


@pytest.mark.parametrize("name", SCENARIOS)
def test_everything_random_is_in_x(name: str) -> None:
    around = problem(name)
    x = around.base.sample(40, np.random.default_rng(1))
    f = around.evaluate(x)
    np.testing.assert_array_equal(around.evaluate(x), f)
    np.testing.assert_array_equal(around.evaluate(x[7:9]), f[7:9])
    other = x.copy()
    columns = around.driver.noise_columns
    other[:, -columns:] = around.base.sample(40, np.random.default_rng(2))[:, -columns:]
    assert (around.evaluate(other) != f).any()
    assert around.space.names[-1] == "ego_noise"
    assert columns == 2 * 20 + 2 + 2 * 12
    assert (around.given, around.varies) == ("", False)


def test_noise_can_be_fixed_or_left_out() -> None:
    x = problem("CutIn", "idm").base.sample(60, np.random.default_rng(0))
    found = {noise: problem("CutIn", noise=noise) for noise in ("fixed", False)}
    assert {each.dim for each in found.values()} == {6}
    assert found["fixed"].given == "the ego's noise is one fixed sequence"
    f = {noise: each.evaluate(x) for noise, each in found.items()}
    assert (f["fixed"] != f[False]).any()
    np.testing.assert_array_equal(f[False], problem("CutIn", HumanEgo(SURE)).evaluate(x))


def test_worlds_and_stacks_that_it_does_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match='Expected action="continuous" for the ego "human"'):
        problem("CarFollowing", action="meta")
    with pytest.raises(ValueError, match="Expected an ego without noise of its own behind a stack"):
        problem("CutIn", agents.load_ego("noisy:human"))
    world = problem("CutIn").world
    with pytest.raises(ValueError, match="call with_draws first"):
        HumanEgo().in_world(world).act(world.start(torch.zeros(1, 6)), None)
