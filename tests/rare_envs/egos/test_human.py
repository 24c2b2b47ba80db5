"""The human ego in its worlds: without human limits its car-following model, late by its reaction time, all in x."""

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
from rare_envs.control.idm import IDM, improved_acceleration
from rare_envs.egos.human import HumanDriver, HumanEgo
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World, drive, rollout
from rare_envs.traffic.bodies import lead_index
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import STANDARD_GRAVITY

SCENARIOS = ("CarFollowing", "CutIn", "HardBrake")
FLAWLESS = HumanDriverModel(
    idm=IDM(),
    reaction_time=0.0,
    gap_error=0.0,
    approach_error=0.0,
    wandering=1.0,  # as far as `lead_of` sees into the next lane
    noticing_time=0.0,
    jerk=math.inf,
    glances=False,
    evasive_share=0.0,
)
SURE = HumanDriverModel(gap_error=0.0, approach_error=0.0, glances=False, evasive_share=0.0)


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


class Heuristic:
    """The improved IDM with the heuristic, by all that there is to know."""

    def act(self, episode: Episode, memory: Any) -> tuple[torch.Tensor, Any]:
        """Answer the ego's lead; behind one that brakes by more than 0.5 m/s^2 without the heuristic."""
        state, index = episode.state, lead_index(episode.state, episode.road)[:, None]
        before = state if memory is None else memory
        braking = ((state.speed - before.speed) / 0.1).gather(1, index)[:, 0]
        cool = 0.99 * (braking >= -0.5).double()
        wanted = improved_acceleration(IDM(), state.speed[:, 0], episode.lead, braking.clamp(max=0.0), coolness=cool)
        return torch.stack((wanted, torch.zeros_like(wanted)), dim=1), state


@pytest.mark.parametrize("name", SCENARIOS)
def test_without_human_limits_it_is_the_improved_idm_with_the_heuristic(name: str) -> None:
    flawless, idm = problem(name, HumanEgo(FLAWLESS)), problem(name, "idm")
    x = torch.from_numpy(idm.base.sample(200, np.random.default_rng(0)))
    if name == "CutIn":
        x[:, 5] = x[:, 5].clamp(max=4.0)  # from further away a driver notices sooner than a lead begins to count
    ego = drive(flawless.world, flawless.driver, x)
    for ours, theirs in zip(ego, drive(idm.world, Heuristic(), x), strict=True):
        there = ~theirs.collided
        torch.testing.assert_close(ours.state.speed[there], theirs.state.speed[there], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("late", [0.0, 0.6])
def test_a_braking_lead_is_answered_one_reaction_time_later(late: float) -> None:
    """Speeds are equal until the lead brakes at 0; the first tick in which its speed differs is 0.1 s."""
    driver = HumanEgo(replace(SURE, reaction_time=late)).in_world(problem("HardBrake").world)
    x = [15.0, 40.0, 4.0, 15.0]
    braking, calm = (accelerations(driver, driver.world, each) for each in (x, [15.0, 40.0, 1e-12, 15.0]))
    differ = [abs(a - b) > 1e-6 for a, b in zip(braking, calm, strict=True)]
    assert differ.index(True) == round(late / 0.1) + 1


@pytest.mark.parametrize("offset", [4.0, 4.8])
def test_a_cutter_is_answered_after_noticing_and_reacting(offset: float) -> None:
    """It is noticed 0.375 m from where it began, or from its lane's centre: in tick k, then 0.4 s and 0.6 s later."""
    world = problem("CutIn").world
    x = [15.0, 12.0, 15.0, 15.0, 60.0, offset]
    driver = HumanDriver(SURE, world)
    blind = HumanDriver(replace(SURE, noticing_time=100.0), world)
    differ = [a != b for a, b in zip(accelerations(driver, world, x), accelerations(blind, world, x), strict=True)]
    offsets = [float(each.state.y[0, 1]) for each in drive(world, blind, torch.tensor([x], dtype=torch.float64))]
    entered = next(tick for tick, y in enumerate(offsets) if y <= offset - 0.375)
    assert 0 < entered < 20
    assert differ.index(True) == entered + 4 + 6


@pytest.mark.parametrize("signals", [True, False])
def test_a_neighbour_who_signals_is_noticed_at_once(signals: bool) -> None:
    """It is answered from the start on, else after its body has moved, by who ignores indicators too."""
    world = rare_envs.DrivingProblem("rare_envs/CutIn-v1", ego="human").world
    x = [20.0, 15.0, 20.0, 25.0, 60.0, 4.0, 6.0, 0.0, 0.0, 1.0 if signals else -1.0, 9.0, 0.0, 0.0]
    first = {}
    for notices in (True, False):
        model = replace(SURE, notice_indicator=notices)
        found, blind = (
            accelerations(HumanDriver(each, world), world, x)
            for each in (model, replace(model, noticing_time=100.0, notice_indicator=False))
        )
        first[notices] = next(tick for tick, (a, b) in enumerate(zip(found, blind, strict=True)) if a != b)
    assert first[False] > 6 + 4
    assert first[True] == (0 if signals else first[False])


def test_braking_builds_up_at_the_published_rate_to_the_published_maximum() -> None:
    world = problem("CarFollowing").world
    decided = accelerations(HumanDriver(SURE, world), world, [30.0, 5.0, 30.0])
    assert decided[:3] == pytest.approx([-1.265, -2.53, -3.795])
    assert min(decided) == pytest.approx(-0.774 * 9.80665)


def look_away(model: HumanDriverModel, x: list[float], glance: tuple[float, float], ticks: int = 45) -> Any:
    """Episodes and memories in car following of a driver who would like to look away from a time to another [s]."""
    world = problem("CarFollowing").world
    start, end = (torch.tensor([[0.0, each]], dtype=torch.float64) for each in glance)
    driver = HumanDriver(model, world, glances=Glances(start, end))
    episode, memory = world.start(torch.tensor([x], dtype=torch.float64)), None
    for _ in range(ticks):
        action, memory = driver.act(episode, memory)
        yield episode, memory
        episode = world.step(episode, action)


def test_what_was_there_at_the_start_does_not_move_before_it_was_seen() -> None:
    """In the first reaction time the percept stays that of time 0, also with the eyes off the road."""
    free = replace(SURE, glance_looming=1.0, glance_eccentricity=180.0)
    known = [memory for _, memory in look_away(free, [20.0, 10.0, 80.0], (0.0, 3.0), 9)]
    gaps = [float(memory.known.gap) for memory in known]
    assert bool(known[-1].glance.away)
    assert gaps == [pytest.approx(80.0)] * 7 + [pytest.approx(80.0 - 0.1 * 10.0), gaps[8]]


def test_in_a_glance_the_lead_is_taken_to_keep_its_speed() -> None:
    world = problem("HardBrake").world
    glance = Glances(torch.tensor([[0.0, 0.5]]), torch.tensor([[0.0, 2.5]]))
    free = replace(SURE, glance_looming=1.0, headway_rule=False, glance_eccentricity=180.0)
    model = replace(free, reaction_time=0.0)
    x, until = [15.0, 20.0, 6.0, 15.0], 5
    away = accelerations(HumanDriver(model, world, glances=glance), world, x)
    seeing = accelerations(HumanDriver(model, world), world, x)
    assert away[:until] == seeing[:until]
    assert all(late > prompt for late, prompt in zip(away[until + 1 : 25], seeing[until + 1 : 25], strict=True))
    assert away[26] < away[24] - 1.0  # it looks back, and brakes


@pytest.mark.parametrize(
    ("speed", "gap", "begun"),
    [(20.0, 58.0, True), (20.0, 50.0, False), (15.0, 24.0, True), (16.0, 24.0, False), (25.0, 49.0, False)],
)
def test_no_glance_is_begun_while_something_comes_nearer(speed: float, gap: float, begun: bool) -> None:
    """Behind 15 m/s: 1.8 m x 5 m/s / gap^2 is .0027 and .0036 rad/s; at 1 m/s from 24 m .0031; 10 m/s from 49 m."""
    model = replace(SURE, reaction_time=0.0, headway_rule=False, glance_ttc=5.0)
    away = [bool(memory.glance.away) for _, memory in look_away(model, [speed, 15.0, gap], (0.0, 0.5), 1)]
    assert away == [begun]
    urgent = replace(model, glance_looming=1.0)  # by the time to collision alone: 10 m/s from 49 m is 4.9 s
    away = [bool(memory.glance.away) for _, memory in look_away(urgent, [speed, 15.0, gap], (0.0, 0.5), 1)]
    assert away == [gap != 49.0]


def test_a_glance_is_broken_off_by_the_looming_that_is_seen_from_there() -> None:
    """It ends in the first tick in which W dv / (s^2 + W^2 / 4) is at the rate of the table, and is not taken up."""
    model = replace(SURE, reaction_time=0.0, headway_rule=False, glance_eccentricity=24.0, glance_looming=1.0)
    model = replace(model, idm=replace(model.idm, comfortable_deceleration=9.0))  # it does not brake early
    ended = []
    for episode, memory in look_away(model, [20.0, 10.0, 80.0], (0.0, 8.0), 80):
        gap, closing = episode.lead.gap.item(), episode.lead.closing_speed.item()
        nearness = min(max(math.log2(gap / 20.0), 0.0), 1.0)
        ended.append(1.8 * closing / (gap**2 + 0.81) >= 0.00646 + nearness * (0.00498 - 0.00646))
        assert bool(memory.glance.away) is not any(ended)
    assert 10 < ended.index(True) < 75
    unseen = look_away(replace(model, glance_eccentricity=180.0), [20.0, 10.0, 80.0], (0.0, 4.0))
    assert [memory.glance.away.item() for _, memory in unseen] == [True] * 40 + [False] * 5


@pytest.mark.parametrize(("rule", "lasting"), [(True, 0.9), (False, 4.0)])
def test_a_glance_is_no_longer_than_headway_less_reaction_time(rule: bool, lasting: float) -> None:
    """30 m at 20 m/s are 1.5 s, of which 0.6 s are for reacting; it begins at 0.3 s, known 0.6 s later."""
    model = replace(SURE, headway_rule=rule, idm=replace(SURE.idm, max_acceleration=1e-9))
    away = [bool(memory.glance.away) for _, memory in look_away(model, [20.0, 20.0, 30.0], (0.25, 4.25), 60)]
    assert (away.index(True), sum(away)) == (9, round(10 * lasting))


def swerve(evades: bool, gap: float = -9.0, ego: float = 15.0, lane: float = 4.0) -> tuple[list[float], list[float]]:
    """Places across of ego and cutter, which comes in beside it from the right and drives away."""
    around = problem("CutIn").world
    world = replace(around, scenario=replace(around.scenario, road=straight(2, lane)))
    driver = HumanDriver(replace(SURE, evasive_share=0.48), world)
    x = torch.tensor([[ego, ego + 4.0, ego + 8.0, gap, 60.0, 4.0, -0.1 if evades else 0.0]], dtype=torch.float64)
    across = [each.state.y[0, :2].tolist() for each in drive(world, driver, x)]
    return [y for y, _ in across], [y for _, y in across]


def test_a_driver_who_steers_makes_room_for_who_comes_in_and_comes_back() -> None:
    """By one metre, at 0.4 g at most, 0.6 s after a body is beside with 0.8 m between; back once it has passed."""
    ego, cutter = swerve(True)
    assert swerve(False)[0] == [0.0] * 101
    begun = next(tick for tick, y in enumerate(ego) if y < 0.0)
    near = next(tick for tick, y in enumerate(cutter) if y < 2.8)
    assert begun == near + 6 + 1  # what is decided in a tick is seen in the next
    assert min(ego) == pytest.approx(-1.0, abs=1e-9)
    assert np.abs(np.diff(ego[: ego.index(min(ego)) + 1], 2)).max() <= 0.4 * 9.80665 * 0.1**2 * (1 + 1e-9)
    assert abs(ego[-1]) < 0.02
    assert np.abs(np.diff(ego, 2)).max() < 0.45 * 9.80665 * 0.1**2  # lane keeping takes over at the end


def test_the_body_stays_inside_its_lane() -> None:
    assert min(swerve(True, lane=3.5)[0]) == pytest.approx(-(3.5 - 2.0) / 2, abs=1e-9)


def test_who_steers_is_a_column_of_x_and_only_a_part_do() -> None:
    around = problem("CutIn")
    assert isinstance(around.driver, HumanDriver)
    draws = torch.zeros(2000, around.driver.noise_columns)
    draws[:, -1] = torch.special.ndtri((torch.arange(2000) + 0.5) / 2000)
    evades = around.driver.with_draws(draws).evades
    assert evades is not None and evades.double().mean().item() == pytest.approx(0.48)
    nobody = HumanEgo(replace(SURE, evasive_share=0.0)).in_world(around.world)
    assert (nobody.noise_columns, HumanEgo(replace(SURE, glances=True)).in_world(around.world).evades) == (0, None)


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
    assert columns == 2 * 20 + 2 + 2 * 12 + 1
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


def test_a_driver_feels_that_its_brakes_are_limited() -> None:
    """It then drives as one that never wants to brake by more than 0.5 g, whatever it would do with better brakes."""
    weak = replace(SURE, idm=replace(SURE.idm, max_deceleration=0.5 * STANDARD_GRAVITY))
    x = torch.tensor([[20.0, 5.0, 30.0], [30.0, 10.0, 30.0]])
    ends = []
    for model, rapid in ((SURE, True), (SURE, False), (weak, True)):
        around = problem("CarFollowing", HumanEgo(model))
        ends.append(rollout(replace(around.world, rapid=rapid), around.driver, x).state.x[:, 0])
    torch.testing.assert_close(ends[1], ends[2])
    assert bool((ends[0] < ends[1]).all())
