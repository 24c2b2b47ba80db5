"""Episodes: their clock, f, what counts as a collision, and statistics of who crashed with whom."""

import math

import pytest
import torch

from rare_envs.measures import MEASURES, TTC_MAX
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.simulation.episode import Clock, Measurement
from rare_envs.simulation.world import World
from rare_envs.traffic.crash import CRASH_KINDS, NONE


def test_ticks_and_decisions() -> None:
    assert Clock(dt=0.25, horizon=0.75).ticks == 3
    assert [Clock(dt=dt, horizon=2.0, action="meta").stride for dt in (1.0, 0.5, 0.1)] == [1, 2, 10]
    assert Clock(dt=0.1, horizon=2.0).stride == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(({"dt": dt}, r"Expected dt in \(0, 1\] s") for dt in (0.0, 1.5, math.nan, math.inf, True, "0.1")),
        *(({"horizon": h}, r"one or more whole ticks of 0\.1 s") for h in (0.0, 0.05, 0.25, math.nan, True, "10")),
        *(({"horizon": h}, r"Expected a horizon below 1e\+06 s") for h in (1e6, math.inf)),
        ({"dt": 0.3, "horizon": 3.0, "action": "meta"}, r"a decision takes 1 s; got dt = 0\.3"),
        ({"horizon": 2.5, "action": "meta"}, r"a decision takes 1 s; got horizon = 2\.5"),
    ],
)
def test_times_that_do_not_go_together_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Clock(**settings)  # type: ignore[arg-type]


def test_f_is_capped_falls_and_stays_at_minus_1() -> None:
    world = World(CAR_FOLLOWING)
    episode = world.start(torch.tensor([[20.0, 25.0, 30.0], [20.0, 10.0, 1.5]]))
    assert float(episode.f[0]) == TTC_MAX
    values = []
    for _ in range(6):
        episode = world.step(episode, torch.zeros(2, 2))
        values.append(float(episode.f[1]))
    assert values[0] > 0.0
    assert values[1:] == [-1.0] * 5
    assert episode.collided.tolist() == [False, True]
    assert float(episode.f[0]) == TTC_MAX


def test_unknown_measures_and_collisions_are_refused() -> None:
    with pytest.raises(ValueError, match="did you mean 'ttc'"):
        Measurement("tcc")
    with pytest.raises(ValueError, match="Expected collisions 'ego' or 'any', got 'all'"):
        Measurement(collisions="all")


def test_only_measures_of_whole_episodes_record() -> None:
    assert Measurement("pet").episode_measure.records
    assert not Measurement("ttc").episode_measure.records
    assert Measurement(lambda moment: moment.state.x[:, 0]).episode_measure not in MEASURES.values()


def test_the_least_time_to_collision_is_kept_whatever_the_measure() -> None:
    """Closing at 5 m/s from 30 m, then the ego brakes: least at the start; a lead that brakes: it falls."""
    for measure in ("ttc", "thw"):
        world = World(CAR_FOLLOWING, measurement=Measurement(measure, statistics=True))
        episode = world.start(torch.tensor([[20.0, 15.0, 30.0]], dtype=torch.float64))
        assert episode.statistics is not None
        assert float(episode.statistics.least_ttc) == pytest.approx(6.0)
        for tick in range(1, 11):
            episode = world.step(episode, torch.zeros(1, 2, dtype=torch.float64))
            assert episode.statistics is not None
            assert float(episode.statistics.least_ttc) == pytest.approx((30.0 - 0.5 * tick) / 5.0)
        for _ in range(20):
            episode = world.step(episode, torch.tensor([[-5.0, 0.0]], dtype=torch.float64))
        assert episode.statistics is not None
        # after 2 s of closing the ego brakes by 0.5 m/s a tick: the gap divided by what is left of 5 m/s
        expected = min((25.0 - sum(0.5 - 0.05 * k for k in range(n))) / (5.0 - 0.5 * n) for n in range(10))
        assert float(episode.statistics.least_ttc) == pytest.approx(min(expected, 5.0))


def test_a_crash_is_recorded_once_with_its_speed() -> None:
    world = World(CAR_FOLLOWING).with_statistics()
    episode = world.start(torch.tensor([[20.0, 10.0, 1.5], [20.0, 20.0, 50.0]]))
    crashes = []
    for _ in range(5):
        episode = world.step(episode, torch.zeros(2, 2))
        assert episode.statistics is not None
        crashes.append(episode.statistics.crash)
    assert [CRASH_KINDS[int(crash.kind[0])] for crash in crashes[1:]] == ["rear_end"] * 4
    assert all(int(crash.kind[1]) == NONE for crash in crashes)
    for crash in crashes[2:]:
        for first, later in zip(crashes[1], crash, strict=True):
            assert torch.equal(first, later)


def test_a_crash_of_others_does_not_hide_that_of_the_ego() -> None:
    """A cutter much faster than the lead runs into it while the ego is far behind."""
    world = World(CUT_IN).with_statistics()
    episode = world.start(torch.tensor([[5.0, 40.0, 5.0, 60.0, 60.0, 2.2]]))
    for _ in range(60):
        episode = world.step(episode, torch.zeros(1, 2))
    assert episode.statistics is not None
    assert int(episode.statistics.own.kind) == NONE
    assert CRASH_KINDS[int(episode.statistics.crash.kind)] == "others"
