"""Strata fitted to events: what drivers accept, who is beside a lane, and how many do not look."""

import numpy as np
import pytest

from rare_envs.distributions.acceptance import log_acceptance
from training.fit.acceptance import fit_pair, profile_limit
from training.fit.base import fit_base
from training.fit.filters import EventSet
from training.fit.strata import UNSEEN_LOG_SD, find_neighbours, keep_strata, share_unseen


def test_what_drivers_accept_is_found_again() -> None:
    """Of 3,000 offers, closing by 0.5 +- 2 m/s, with b = 0.5: b to a third, the offers' mean to 0.2 m/s."""
    rng = np.random.default_rng(0)
    gap, closing = rng.lognormal(2.8, 0.7, 3000), rng.normal(0.5, 2.0, 3000)
    kept = (gap > 1.0) & (gap < 120.0) & (rng.random(3000) < np.exp(log_acceptance(gap, closing, 0.5)))
    found = fit_pair(closing[kept], gap[kept], (1.0, 120.0))
    assert found.limit == pytest.approx(0.5, rel=0.35)
    assert found.mean == pytest.approx([0.5, 2.8], abs=0.2)
    profile = profile_limit(closing[kept], gap[kept], (1.0, 120.0))
    assert max(profile, key=lambda b: profile[b]) == "0.5" and profile["0.5"] > 20.0


def test_neighbours_are_those_between_whom_a_vehicle_would_come() -> None:
    """Lane 2 has vehicles of 5 m at 0, 20 and 60 m; a vehicle beside, from 18 to 23 m, would come behind the third."""
    rear = np.array([0.0, 20.0, 60.0, 18.0])
    rows, own = find_neighbours(
        np.zeros(4), np.array([2, 2, 2, 1]), rear, rear + 5.0, np.array([10.0, 11.0, 12.0, 13.0])
    )
    assert own.tolist() == [3]
    assert rows.tolist() == [[11.0, 13.0, 12.0, -7.0, 37.0]]


def test_the_share_who_do_not_look_is_that_of_44_events() -> None:
    """One in 6,100 on US 101; 2 km of changes for one halve it. A factor of 4 either way at 95 %."""
    assert share_unseen(0.26, 0.321) == pytest.approx(1 / 6100, rel=0.01)
    assert share_unseen(0.52, 0.321) == pytest.approx(share_unseen(0.26, 0.321) / 2.0)
    assert np.exp(1.96 * UNSEEN_LOG_SD) == pytest.approx(4.3, abs=0.1)


def brakings(stops: int) -> EventSet:
    """60 brakings, each a cluster of its own; the first so many to a standstill."""
    rng = np.random.default_rng(0)
    speed, loss = rng.uniform(12.0, 20.0, 60), rng.uniform(4.0, 9.0, 60)
    loss[:stops] = speed[:stops]
    rows = np.column_stack([speed, rng.lognormal(2.5, 0.4, 60), rng.lognormal(0.7, 0.3, 60), loss])
    return EventSet(rows, np.arange(60))


@pytest.mark.parametrize(("stops", "left"), [(7, ["slowing"]), (53, ["stop"]), (30, ["slowing", "stop"])])
def test_a_stratum_of_too_few_brakings_is_left_out_of_all(quick, stops: int, left: list[str]) -> None:
    """Of 60 brakings, some to a standstill: refits have the strata of the fit, and the events are those of these."""
    base = fit_base("hard_brake", brakings(stops), {}, "a test", n_refits=8)
    assert [[each.name for each in one.strata] for one in (base, *base.refits)] == [left] * 9
    assert base.events.used == ({7: 53, 53: 53, 30: 60}[stops],)


def test_the_share_of_a_stratum_of_few_is_right_in_the_mean_of_the_refits(quick) -> None:
    """10 of 60: refits that left out draws of fewer than 10 would have .200 in the mean, none below 1 / 6."""
    base = fit_base("hard_brake", brakings(10), {}, "a test", n_refits=40)
    shares = np.array([one.strata[1].share for one in base.refits])
    deviation = np.sqrt(1 / 6 * 5 / 6 / 60)
    assert shares.mean() == pytest.approx(1 / 6, abs=3.0 * deviation / 40**0.5)
    assert shares.std() == pytest.approx(deviation, rel=0.25)


def test_too_few_of_both_strata_are_none() -> None:
    rows = np.column_stack([np.full(18, 15.0), np.full(18, 10.0), np.full(18, 2.0), np.repeat([15.0, 5.0], 9)])
    with pytest.raises(ValueError, match="18 events are too few; 10 of a stratum are needed"):
        keep_strata(EventSet(rows, np.arange(18)))
