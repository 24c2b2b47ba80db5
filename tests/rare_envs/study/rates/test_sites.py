"""Rates at other sites over that at one's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import pytest

from rare_envs.scenarios.hard_brake import HARD_BRAKE
from rare_envs.scenarios.registry import SCENARIOS, scenario_named
from rare_envs.study import Question, Report, prepare, run
from rare_envs.study.risk import choose_base, compare_sites
from tests.rare_envs.study.fitted_files import fitted_entries

OTHER_SITE = {"source": {"site": "another", "data": "more"}}


@pytest.fixture
def sites(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hard brake at three sites, with further bases of two of them, and an assembled one."""
    near = fitted_entries("hard_brake", shift=0.2, provenance=OTHER_SITE)
    near["frequency"] = {**near["frequency"], "count": 84}
    bases = {
        "us101": fitted_entries("hard_brake"),
        "near": near,
        "far": fitted_entries("hard_brake", shift=6.0, provenance={"source": {"site": "a third"}}),
        "near-gap": fitted_entries("hard_brake", shift=0.3, provenance=OTHER_SITE),
        "again": fitted_entries("hard_brake", shift=0.1),
        "assembled": fitted_entries("hard_brake", refits=None, events=None, family=None, frequency=None, checks=None),
    }
    scenario = replace(HARD_BRAKE, bases=MappingProxyType(bases))
    monkeypatch.setitem(SCENARIOS._entries, "rare_envs/HardBrake-v0", scenario)


def report() -> Report:
    return run(prepare(Question(env_id="rare_envs/HardBrake-v0", method="mc", max_sim=1000)))


def test_other_sites_are_known_from_the_same_simulations(sites: None) -> None:
    """The near site has twice the frequency."""
    own = report()
    factors = compare_sites(own, ())
    assert list(factors) == ["near"]
    p = run(prepare(Question(env_id="rare_envs/HardBrake-v0", base="near", method="mc", max_sim=4000))).estimate
    assert factors["near"] == pytest.approx(2 * p.p / own.estimate.p, rel=0.15)


def test_the_base_of_a_scenario_at_a_site() -> None:
    assert choose_base(HARD_BRAKE, None, "us101") == ("us101", ())
    assert choose_base(HARD_BRAKE, Path("mine.json"), "us101") == ("mine.json", ())
    assert choose_base(HARD_BRAKE, "us101", "i80") == ("us101", ())
    with pytest.raises(ValueError, match=r"hard_brake has no base of the site 'i80' \(it has us101\): --base hard_br"):
        choose_base(HARD_BRAKE, None, "i80")


def test_a_base_whose_events_were_not_counted_gives_way_to_one_whose_were() -> None:
    """Pairs of US 101 were under way, and cannot be counted; the new leaders of I-80 were."""
    car_following = scenario_named("car_following")
    base, notes = choose_base(car_following, None, "us101")
    assert base == "i80"
    assert notes == ("it has no event frequency at 'us101': 'i80' is used",)
    assert choose_base(car_following, None, "i24") == ("i24", ())
    assert choose_base(car_following, "us101", "us101") == ("us101", ())  # refused with its reason later
