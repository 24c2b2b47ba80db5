"""The cutter of `CutIn-v1`, by pencil and paper: when it turns back, when it goes on, and what it never does."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import ndtr, ndtri
from torch import Tensor

import rare_envs
from rare_envs.control.human_driver import ATTENTIVE_IDM
from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.cut_in import ATTENTION_LIMIT, CUT_IN, CUT_IN_V1, CUTTER_IDM, CutterModel
from rare_envs.simulation import World, drive
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import rollout
from rare_envs.traffic.state import State
from tests.rare_envs.traffic_states import F64, tensor

NAMES = [each.name for each in CUT_IN_V1.parameters]
STEADY_IDM = replace(ATTENTIVE_IDM, desired_speed=1.0)
STEADY = CutterModel(idm=STEADY_IDM).scenario()
"""Its cutter wishes for no more than the speed that it begins with: ways with pencil and paper."""
KEEPS = {"lead_speed": 20.0, "lead_gap": 150.0, "lead_braking": 9.0}  # a lead that nobody minds
UNSEEN = {"attention": ATTENTION_LIMIT - 1.0}


class Coasting:
    """An ego that keeps its speed."""

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        return torch.zeros_like(episode.state.x[:, :2]), memory


def point(**given: float) -> Tensor:
    """Return x (1, 13): 20 m/s all, the cutter far ahead, 4 s for 3.5 m, its driver looking."""
    usual = {"ego_speed": 20.0, "cut_in_speed": 20.0, "cut_in_gap": 60.0, "lateral_offset": 3.5, "duration": 4.0}
    return tensor(*(({**usual, **KEEPS, **given}).get(name, 0.0) for name in NAMES))[None]


def states(x: Tensor, scenario: Scenario = STEADY) -> list[State]:
    return [each.state for each in drive(World(scenario), Coasting(), x)]


def across(x: Tensor, scenario: Scenario = STEADY) -> np.ndarray:
    """Return y of the cutter, at each tick."""
    return np.array([each.y[0, 1].item() for each in states(x, scenario)])


FREE = across(point())


@pytest.mark.parametrize("duration", [2.5, 4.0, 7.5])
def test_in_free_traffic_the_change_takes_its_duration(duration: float) -> None:
    """y = 3.5 m (1 - 3 s^2 + 2 s^3) with s = t / duration; along the road the cutter is slower by the cosine.

    That is of a slope of 1.5 x 3.5 m / (20 m/s duration) at most: by half its square.
    """
    x = point(duration=duration)
    y, s = across(x), np.minimum(np.arange(101) / (10.0 * duration), 1.0)
    slower = (1.5 * 3.5 / (20.0 * duration)) ** 2 / 2
    assert np.abs(y - 3.5 * (1.0 - 3.0 * s**2 + 2.0 * s**3)).max() < 3.5 * 1.5 * slower
    assert y[0] == 3.5 and y[-1] == 0.0 and not evades(x)


def evades(x: Tensor) -> bool:
    assert CUT_IN_V1.evades is not None
    return bool(CUT_IN_V1.evades(states(x)[-1]))


def test_whoever_looks_turns_back_a_reaction_time_after_and_waits_outside() -> None:
    """Beside the ego from the start: forward for 0.6 s, back for as long, and then it stays."""
    x = point(cut_in_gap=-3.0)
    y = across(x)
    assert y.argmin() == 6
    assert y[:7] == pytest.approx(FREE[:7], abs=1e-12)
    assert y[6:13] == pytest.approx(FREE[6::-1], abs=1e-4)
    assert (y[13:] == 3.5).all()
    heading = np.array([each.heading[0, 1].item() for each in states(x)])
    assert (heading[1:7] < 0.0).all() and (heading[7:12] > 0.0).all() and (heading[13:] == 0.0).all()
    assert not evades(x)  # it had looked: no rapid manoeuvre


@pytest.mark.parametrize(("gap", "free", "left"), [(-2.0, 13, 0), (-1.6, 11, 1)])
def test_it_goes_on_when_the_place_is_free(gap: float, free: int, left: int) -> None:
    """2 m/s faster than the ego, 5 m + gap + 2 t reaches 5.5 m: at tick 13, or 11; it has gone back since tick 6."""
    y = across(point(ego_speed=18.0, cut_in_gap=gap))
    assert y[6] == y[: free + 1].min() and y[free] == pytest.approx(FREE[left], abs=1e-3)
    assert y[free:90] == pytest.approx(FREE[left : 90 - free + left], abs=2e-3)


def test_it_turns_back_in_front_of_an_ego_that_would_have_to_brake_hard() -> None:
    """5 m/s faster, the ego needs over 2 m/s^2 from 25 / 4 m = 6.25 m on: 10 m - 5 t is below it from tick 8 on."""
    y = across(point(ego_speed=25.0, cut_in_gap=10.0))
    assert y[:15] == pytest.approx(FREE[:15], abs=1e-12) and y[15] > y[14]
    bold = CutterModel(idm=STEADY_IDM, most_braking=1e9).scenario()
    assert across(point(ego_speed=25.0, cut_in_gap=10.0), bold)[15] < y[14]


class Slowing(Coasting):
    """An ego that brakes by 2 m/s^2."""

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        return torch.tensor([-2.0, 0.0], dtype=F64).expand(len(episode.collided), 2), memory


@pytest.mark.parametrize("attention", [0.0, ATTENTION_LIMIT - 1.0])
@pytest.mark.parametrize("looks", [True, False])
def test_whoever_drops_in_behind_the_ego_follows_it(looks: bool, attention: float) -> None:
    """The ego passes: 10 m/s faster at first and 10 m/s slower after 10 s, when it would be where the cutter is."""
    x = point(ego_speed=30.0, cut_in_gap=-7.0, duration=8.0, attention=attention)
    end = rollout(World(CutterModel(looks=looks).scenario()), Slowing(), x)
    ego, cutter, _ = end.state.vehicles
    assert cutter.y.item() == 0.0 and bool(end.collided) is not looks
    if looks:
        assert 2.0 < (ego.x - cutter.x - 5.0).item() and cutter.speed.item() < 15.0


@pytest.mark.parametrize(("delay", "ticks"), [(0.1, 1), (0.25, 3), (0.5, 5)])
def test_whoever_has_not_looked_notices_late_and_then_turns_at_once(delay: float, ticks: int) -> None:
    """The body is over the line where y < 3 m: 3 s^2 - 2 s^3 > 1/7 from s = 0.236 on, at tick 10 of 40."""
    x = point(cut_in_gap=-3.0, noticing=np.log(delay / 0.1) / 0.3 - 1e-9, **UNSEEN)
    y = across(x)
    assert (y < 3.0).argmax() == 10
    assert y.argmin() == 10 + ticks and y[: 11 + ticks] == pytest.approx(FREE[: 11 + ticks], abs=1e-12)
    assert evades(x) and not evades(point(**UNSEEN))  # where nobody is beside it, it just goes on


def test_two_in_44_never_notice() -> None:
    z = ndtri(2.0 / 44.0)
    assert across(point(cut_in_gap=-3.0, noticing=z - 1e-6, **UNSEEN)) == pytest.approx(FREE, abs=1e-12)
    assert across(point(cut_in_gap=-3.0, noticing=z + 1e-6, **UNSEEN))[-1] == 3.5
    assert ndtr(ATTENTION_LIMIT) == pytest.approx(1.6e-4)


def draws(n: int) -> Tensor:
    """Return scenarios in which egos and cutters get beside each other, all of whose drivers look."""
    rng, box = np.random.default_rng(1), {"cut_in_gap": (-10.0, 30.0), "lead_gap": (1.0, 80.0), "duration": (1.5, 8.0)}
    box |= {name: (5.0, 35.0) for name in NAMES[:3]} | {"lateral_offset": (2.2, 5.0)}
    x = rng.standard_normal((n, len(NAMES)))
    for name, (low, high) in box.items():
        x[:, NAMES.index(name)] = rng.uniform(low, high, n)
    x[:, NAMES.index("attention")] = 0.0
    return torch.from_numpy(x)


@pytest.mark.parametrize("looks", [True, False])
def test_whoever_looks_never_moves_into_a_body_beside_it(looks: bool) -> None:
    """Contacts flank to flank while y falls, after the place has been taken for over 0.6 s: none, and many unless."""
    episodes = drive(World(CutterModel(looks=looks).scenario()), Coasting(), draws(2000))
    taken = torch.zeros(2000)  # ticks for which the ego has been beside the cutter or too fast behind it
    before, into = next(episodes), 0
    for after in episodes:
        ego, cutter = before.state.vehicles[:2]
        gap, closing = cutter.x - ego.x - 5.0, (ego.speed - cutter.speed).clamp(min=0.0)
        pressed = (gap >= 0.0) & (closing**2 > 4.0 * gap)
        taken = torch.where(((cutter.x - ego.x).abs() < 5.5) | pressed, taken + 1, 0.0)
        flank = (after.state.x[:, 1] - after.state.x[:, 0]).abs() < 5.0
        falling = after.state.y[:, 1] < before.state.y[:, 1]
        into += int((after.collided & ~before.collided & flank & falling & (taken > 6)).sum())
        before = after
    assert into == 0 if looks else into > 50


def test_the_later_it_is_noticed_the_more_often_they_touch() -> None:
    """Noticed 0.1, 0.5 and 1.5 s after the body is over the line, and never."""
    x = draws(800).repeat(4, 1, 1)
    x[..., NAMES.index("attention")] = ATTENTION_LIMIT - 1.0
    x[..., NAMES.index("noticing")] = tensor(0.0, np.log(5.0) / 0.3, np.log(15.0) / 0.3, -3.0)[:, None]
    touched = rollout(World(CUT_IN_V1), Coasting(), x.flatten(0, 1)).collided.view(4, -1).sum(1).tolist()
    assert touched == sorted(touched) and touched[-1] > 1.2 * touched[0] > 0


def test_who_has_not_looked_is_told_by_attention_alone() -> None:
    """Beside the ego, those below the limit of attention who never notice it touch it, and nobody else does."""
    below = float(np.nextafter(ATTENTION_LIMIT, -9.0))
    touched = [
        rollout(World(CUT_IN_V1), Coasting(), point(cut_in_gap=-3.0, noticing=-3.0, attention=each)).collided.item()
        for each in (-9.0, below, ATTENTION_LIMIT, 9.0)
    ]
    assert touched == [True, True, False, False]


def test_a_lead_brakes_once_in_a_parabola() -> None:
    """At 20 m/s brakings have a chance of 0.246 in 10 s; a rank of a fifth of it is an onset of 2 s.

    Peak and loss of their medians, e^0.730 and e^1.572: 1.5 loss / peak = 3.48 s.
    """
    x = point(lead_braking=ndtri(0.2 * 0.246))
    speed, place = (
        np.array([each[0, 2].item() for each in field])
        for field in zip(*((s.speed, s.x) for s in states(x)), strict=True)
    )
    peak, loss = np.exp(0.730), np.exp(1.572)
    lasting = 1.5 * loss / peak
    assert (speed[:21] == 20.0).all() and speed[21] < 20.0
    assert speed[-1] == pytest.approx(20.0 - loss, abs=1e-12)
    assert -np.diff(speed).min() / 0.1 == pytest.approx(peak, rel=1e-2)
    way = 20.0 * 10.0 - loss * (8.0 - lasting / 2) + 0.1 * loss / 2  # half a step of Euler's method
    assert place[-1] - place[0] == pytest.approx(way, abs=1e-2)
    never = states(point(lead_braking=ndtri(0.246) + 1e-6))
    never += states(point(lead_braking=-40.0), CutterModel(brakings_per_km=0.0).scenario())
    assert all(each.speed[0, 2] == 20.0 for each in never)
    slow = states(point(lead_speed=2.0, cut_in_speed=2.0, ego_speed=2.0, lead_braking=-9.0))
    assert slow[-1].speed[0, 2] == 0.0  # no more than its speed is lost
    stands = states(point(lead_speed=0.0, lead_braking=-40.0, lead_peak=-400.0))
    assert stands[-1].speed[0, 2] == 0.0 and bool(stands[-1].x.isfinite().all())


def test_the_indicator_is_on_until_the_change_is_over() -> None:
    assert CUT_IN_V1.signals is not None
    z = ndtri(1.0 - 0.64)
    on, off = (states(point(indicator=z + e)) for e in (1e-6, -1e-6))
    assert CUT_IN_V1.signals(on[0]).tolist() == CUT_IN_V1.signals(on[39]).tolist() == [[True, False]]
    assert not CUT_IN_V1.signals(on[-1]).any() and not CUT_IN_V1.signals(off[0]).any()


def test_without_looks_and_heuristic_and_braking_it_is_the_script_of_the_first_version() -> None:
    x = torch.from_numpy(
        rare_envs.DrivingProblem("rare_envs/CutIn-v0", base="i80").base.sample(100, np.random.default_rng(2))
    )
    rest = tensor(4.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0).expand(100, -1)
    own_speed = replace(CUTTER_IDM, desired_speed=1.0)  # no faster than at the start
    script = CutterModel(looks=False, idm=own_speed, coolness=None).scenario()
    for one, other in zip(states(torch.cat((x, rest), dim=1), script), states(x, CUT_IN), strict=True):
        for mine, theirs in zip(one[:4], other[:4], strict=True):
            torch.testing.assert_close(mine, theirs, rtol=0.0, atol=1e-9)


def test_the_cutter_of_the_human_kind_does_not_brake_for_the_gap_it_has_chosen() -> None:
    """3 m behind a lead at its own speed: the script brakes fully, recorded cutters by 0."""
    x = point(lead_gap=3.0)
    script = CutterModel(idm=CUTTER_IDM, coolness=None).scenario()
    human, scripted = (states(x, each)[20].speed[0, 1].item() for each in (CUT_IN_V1, script))
    assert scripted < 20.0 - 2.0 * 2.0 and human > 20.0 - 2.0 * 1.5


def test_the_cutter_speeds_up_behind_a_faster_lead_as_human_drivers_do() -> None:
    """At 20 m/s, far behind a lead at 30, by a (1 - (v / v0)^4) = 0.87 m/s^2; at 33 it is content."""
    x = point(lead_speed=30.0, lead_gap=100.0)
    start, later = (states(x, CUT_IN_V1)[tick].speed[0, 1].item() for tick in (0, 10))
    assert start == 20.0 and later - start == pytest.approx(1.0 - (20.0 / (120 / 3.6)) ** 4, abs=0.06)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("indicating", -0.2),
        ("oblivious", 1.5),
        ("coolness", np.nan),
        ("reaction_time", np.inf),
        ("braking_window", 0.0),
        ("peak", (np.nan, 0.4)),
        ("peak", (0.7,)),
        ("loss", (1.6, -0.3)),
        ("loss", (np.inf, 0.3)),
    ],
)
def test_a_cutter_that_cannot_be_is_refused(name: str, value: Any) -> None:
    with pytest.raises(
        ValueError, match=f"^Expected {name} of the cutter to be a .*, got {re.escape(repr(value))}\\.$"
    ):
        CutterModel(**{name: value})


def test_drivers_take_the_pedals_and_not_the_looks() -> None:
    """With accelerations of drivers the cutter speeds up as told, and turns back as ever."""
    state = CUT_IN_V1.initial(point(cut_in_gap=-3.0))
    action = torch.zeros(1, 2, 2, dtype=F64)
    action[..., 0] = tensor(1.0, -2.0)
    found = []
    for _ in range(8):
        after = CUT_IN_V1.driven(state, action, 0.1)
        assert after.theta is not None
        x, y, heading, speed = (torch.cat((a[:, :1], b), dim=1) for a, b in zip(state[:4], after[:4], strict=True))
        state = State(x + tensor(2.0, 0.0, 0.0), y, heading, speed, after.theta)
        found.append(state.y[0, 1].item())
    assert state.speed[0].tolist() == pytest.approx([20.0, 20.8, 18.4])
    assert np.argmin(found) == 5  # after six ticks
