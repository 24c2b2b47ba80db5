"""The clock: ticks, decisions, and times that do not go together."""

import math

import pytest

from rare_envs.simulation.episode import Clock


def test_ticks_and_decisions() -> None:
    assert Clock(dt=0.1, horizon=10.0).ticks == 100
    assert Clock(dt=0.25, horizon=0.75).ticks == 3
    assert [Clock(dt=dt, horizon=2.0, action="meta").stride for dt in (1.0, 0.5, 0.1)] == [1, 2, 10]
    assert Clock(dt=0.1, horizon=2.0).stride == 1


@pytest.mark.parametrize("dt", [0.0, -0.1, 1.5, math.nan, math.inf, True, "0.1", None])
def test_wrong_ticks_are_refused(dt: float) -> None:
    with pytest.raises(ValueError, match=r"Expected dt in \(0, 1\] s"):
        Clock(dt=dt)


@pytest.mark.parametrize("horizon", [0.0, 0.05, 0.25, -1.0, math.nan, True, "10"])
def test_horizons_are_whole_numbers_of_ticks(horizon: float) -> None:
    with pytest.raises(ValueError, match=r"horizon of one or more whole ticks of 0\.1 s"):
        Clock(dt=0.1, horizon=horizon)


@pytest.mark.parametrize("horizon", [1e6, 1e9, math.inf])
def test_horizons_of_days_are_taken_for_other_units(horizon: float) -> None:
    with pytest.raises(ValueError, match=r"Expected a horizon below 1e\+06 s"):
        Clock(dt=0.1, horizon=horizon)


@pytest.mark.parametrize(("dt", "horizon", "name"), [(0.3, 3.0, "dt = 0.3"), (0.1, 2.5, "horizon = 2.5")])
def test_meta_actions_take_whole_seconds(dt: float, horizon: float, name: str) -> None:
    Clock(dt, horizon)
    with pytest.raises(ValueError, match=f"a decision takes 1 s; got {name}"):
        Clock(dt, horizon, action="meta")
