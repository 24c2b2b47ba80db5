"""Terms of an episode by hand: values, ticks, what a collision belongs to, and the order on which to search."""

import math

import pytest
import torch

from rare_envs.measures import MEASURES, Measure, Moment
from rare_envs.measures.registry import PAIR_CLEARANCE, TermState, TermTracker, find_order
from tests.rare_envs.measures.moments import moment

EGO = (0.0, 0.0, 0.0, 20.0)


def track(order: Measure, moments: list[Moment], collided: list[bool], ticks: int = 10) -> TermState:
    """Fold moments of one episode; `collided` says it of each moment."""
    tracker = TermTracker(MEASURES["ttc"], order)
    state = tracker.start(moments[0], ticks)
    for at, before, now in zip(moments[1:], collided, collided[1:], strict=False):
        state = tracker.update(state, at, torch.tensor([before]), torch.tensor([now]))
    return state


def beside(*ways: tuple[float, float]) -> Moment:
    """The ego, and vehicles that are so far ahead and to the right of its centre."""
    return moment(EGO, *((ahead, aside, 0.0, 20.0) for ahead, aside in ways))


def test_each_vehicle_has_its_least_distance_and_the_tick_of_it() -> None:
    drives = [beside((25.0, 0.0), (0.0, 4.0)), beside((15.0, 0.0), (0.0, 5.0)), beside((20.0, 0.0), (0.0, 3.0))]
    state = track(MEASURES["clearance"], drives, [False] * 3)
    assert state.values.tolist() == [[10.0, 1.0, 1000.0, 1000.0]]  # bumpers 5 m apart, sides 2 m
    assert state.ticks[0, :2].tolist() == [1, 2]


def test_what_comes_after_the_cut_is_a_term_of_its_own() -> None:
    gaps = [30.0, 20.0, 25.0, 18.0]
    state = track(MEASURES["clearance"], [beside((gap + 5.0, 0.0)) for gap in gaps], [False] * 4, ticks=4)
    assert state.values.tolist() == [[20.0, 18.0]]  # ticks 0 and 1 are early, 2 > 0.45 * 4 is late
    assert state.ticks.tolist() == [[1, 3]]


def test_a_collision_belongs_to_the_vehicle_that_was_hit_and_ends_the_episode() -> None:
    drives = [beside((7.0, 0.0), (0.0, 2.5)), beside((4.5, 0.0), (0.0, 2.25)), beside((3.0, 0.0), (0.0, 2.0))]
    state = track(MEASURES["clearance"], drives, [False, True, True])
    assert state.values[0, :2].tolist() == [-1.0, 0.5]  # the moment of a collision is not measured
    assert state.ticks[0, :2].tolist() == [1, 0]


def test_off_the_road_a_collision_belongs_to_the_nearest_or_to_the_edge() -> None:
    gone = moment((0.0, -2.5, 0.0, 20.0), (30.0, 0.0, 0.0, 20.0), (0.0, 4.0, 0.0, 20.0))
    for name, term in (("clearance", 1), ("ttc", 2), ("ttc_2d", 2)):
        state = track(MEASURES[name], [beside((30.0, 0.0), (0.0, 4.0)), gone], [False, True])
        assert (state.values <= 0.0).nonzero()[:, 1].tolist() == [term], name
    hit = moment((0.0, -2.5, 0.0, 20.0), (1.0, -2.0, 0.0, 20.0))  # it is off the road, but it has hit somebody
    state = track(MEASURES["ttc_2d"], [beside((30.0, 0.0)), hit], [False, True])
    assert (state.values <= 0.0).nonzero()[:, 1].tolist() == [0]


def test_pairs_and_their_names() -> None:
    at = moment(EGO, (25.0, 0.0, 0.0, 20.0), (25.0, 3.0, 0.0, 20.0))
    assert PAIR_CLEARANCE.term_values(at)[0].tolist() == pytest.approx([20.0, math.hypot(20.0, 1.0), 1.0])
    names = TermTracker(MEASURES["ttc"], PAIR_CLEARANCE).names(("ego", "a", "b"))
    assert names[:3] == tuple(f"{pair}, 0 to 45 % of the time" for pair in ("ego and a", "ego and b", "a and b"))
    assert len(names) == 6
    touching = moment(EGO, (25.0, 0.0, 0.0, 20.0), (25.0, 1.5, 0.0, 20.0))
    state = track(PAIR_CLEARANCE, [at, touching], [False, True])
    assert state.values.argmin(1).item() == 2


def test_the_order_is_the_distance_where_failure_is_a_collision() -> None:
    clearance = MEASURES["clearance"]
    for name in ("ttc", "ttc_2d", "margin", "mttc", "thw", "clearance"):
        assert find_order(MEASURES[name], "ego", 0.0) == (clearance, 0.0)
        assert find_order(MEASURES[name], "any", 0.0) == (PAIR_CLEARANCE, 0.0)
        assert find_order(MEASURES[name], "ego", 0.5) == (MEASURES[name], 0.5)
    for name in ("lidar_ttc", "drac", "rss_margin"):  # these may fail without a collision
        assert find_order(MEASURES[name], "ego", 0.0) == (MEASURES[name], 0.0)
    for name in ("tet", "tit", "pet"):  # no least over moments
        assert find_order(MEASURES[name], "ego", 0.5) == (None, 0.5)
