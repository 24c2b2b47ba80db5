"""Bases fitted to events: what is left out of the box, dangerous states, what the record says, the file read back."""

import json

import numpy as np
import pytest
from scipy.stats import norm

from rare_envs.distributions.events import EventFrequency
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario
from training.fit.base import fit_base, format_base
from training.fit.checks import CHECK_DRAWS, check_predictions
from training.fit.filters import EventSet

FREQUENCY = EventFrequency(count=60, hours=6.0, km=200.0, definition="a pair begins", source="made up")
SOURCE = {"site": "nowhere", "data": "made up", "licence": "none"}


def fitted(n=60, **changes):
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.normal(15.0, 3.0, (n, 2)), np.exp(rng.normal(3.0, 0.4, n))])
    events = EventSet(x, np.arange(n) // 4, cluster="scene")
    return fit_base("car_following", events, SOURCE, "by hand", frequency=FREQUENCY, n_refits=3, **changes)


def test_a_base_carries_all_that_says_what_it_is_worth_and_so_does_its_file(quick, tmp_path):
    base = fitted()
    assert len(base.refits) == 3
    assert (base.events.used, base.events.clusters, base.events.cluster) == ((60,), 15, "scene")
    assert base.frequency == FREQUENCY
    assert [check.name for check in base.checks] == ["TTC < 5 s", "needed deceleration > 1 m/s^2", "gap < 3 m"]
    selection = base.record["selection"]
    assert [entry["coordinates"] for entry in selection][:2] == ["plain", "log gap"]
    own = next(entry for entry in selection if entry["coordinates"] == base.record["coordinates"])
    assert base.record["bic"] == own["bic"] == min(c["bic"] for c in own["components"] if c["accepted"])
    path = tmp_path / "car_following_own.json"
    path.write_text(format_base("car_following", base.to_dict()), encoding="utf-8")
    data = json.loads(path.read_text(encoding="utf-8"))
    assert (data["names"], data["units"]) == (["ego_speed", "lead_speed", "gap"], ["m/s", "m/s", "m"])
    again = load_base(find_scenario("car_following"), path)
    x = base.sample(100, np.random.default_rng(0))
    for one, other in zip((base, *base.refits), (again, *again.refits), strict=True):
        assert np.array_equal(one.log_prob(x), other.log_prob(x))
    written, read = base.to_dict(), again.to_dict()
    assert {**written, "names": read.get("names")} == {**read, "names": read.get("names")}  # a file always has them
    assert fitted(system="plain").family.endswith("plain")
    with pytest.raises(ValueError, match="Unknown coordinate system 'polar'; known are plain, log gap, closing"):
        fitted(system="polar")


def test_expected_counts_are_shares_times_events():
    """Gaps are N(10, 4^2) within [1, 150]: P[gap < 3] = (Phi(-7/4) - Phi(-9/4)) / (1 - Phi(-9/4))."""
    box = [0.0, 0.0, 1.0], [45.0, 45.0, 150.0]
    base = TruncatedGaussianMixture([1.0], [[20.0, 20.0, 10.0]], [np.diag([4.0, 4.0, 16.0])], *box)
    events = base.sample(400, np.random.default_rng(1))
    found = check_predictions("car_following", ("ego_speed", "lead_speed", "gap"), events, base)
    check = next(each for each in found if each.name == "gap < 3 m")
    share = (norm.cdf(-7 / 4) - norm.cdf(-9 / 4)) / norm.sf(-9 / 4)
    assert check.recorded == int((events[:, 2] < 3.0).sum())
    atol = 4 * 400 * np.sqrt(share / CHECK_DRAWS) + 0.005 * 400 * share
    assert check.expected == pytest.approx(400 * share, abs=atol)


def test_a_cut_in_has_two_pairs_and_an_unknown_scenario_none():
    names = ("ego_speed", "cut_in_speed", "lead_speed", "cut_in_gap", "lead_gap", "lateral_offset")
    d = len(names)
    base = TruncatedGaussianMixture([1.0], [[20.0] * d], [np.eye(d)], [1.0] * d, [150.0] * d)
    events = np.array([[20.0, 20.0, 10.0, 50.0, 40.0], [20.0, 10.0, 20.0, 2.0, 40.0]])
    checks = {check.name: check.recorded for check in check_predictions("cut_in", names, events, base)}
    assert checks == {
        "TTC < 5 s, cut_in_gap": 1,  # 10 m/s faster at 2 m
        "needed deceleration > 1 m/s^2, cut_in_gap": 1,
        "gap < 3 m, cut_in_gap": 1,
        "TTC < 5 s, lead_gap": 1,  # the cutter, 10 m/s faster than its lead at 40 m
        "needed deceleration > 1 m/s^2, lead_gap": 1,  # 100 / 80
        "gap < 3 m, lead_gap": 0,
    }
    assert check_predictions("merge", names, events, base) == ()
