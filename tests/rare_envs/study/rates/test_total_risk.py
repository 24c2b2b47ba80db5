"""Risks of the IDM under bases on which it often crashes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rare_envs
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.study import BadInput
from tests.rare_envs.study.fitted_files import fitted_entries, write_fitted

FEW = {"method": "mc", "max_sim": 400}


@pytest.fixture
def bases(tmp_path: Path) -> dict[str, str]:
    return {name: write_fitted(tmp_path / f"{name}.json", name) for name in ("cut_in", "hard_brake")}


class Coasting:
    """An ego of the user's own, which does nothing."""

    observation_space = action_space = None

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), np.float32), state


def test_the_total_is_the_sum_of_frequency_times_p(bases: dict[str, str]) -> None:
    found = rare_envs.risk("idm", bases=bases, **FEW)
    p = [each.report.estimate.p for each in found.scenarios]
    expected = 1e6 * (1221 * 38 / 46 / 3900 * p[0] + 42 / 218 * p[1])
    assert found.total.per_million_km == pytest.approx(expected)
    low, high = found.total.interval_per_million_km
    assert 0 < low < expected < high
    assert sum(found.kinds.values()) == pytest.approx(expected)
    assert found.recorded_events == {"cut_in": 38, "hard_brake": 42}
    assert found.notes == ()
    text = str(found)
    assert text.startswith("collisions per million km  ")
    assert "people: 21 contacts of all kinds" in text
    assert "38 + 15 events of 17 scenes" in text
    assert "the uncertainty is" in text


def test_an_ego_that_is_an_object(bases: dict[str, str]) -> None:
    found = rare_envs.risk(Coasting(), scenarios=("hard_brake",), bases={"hard_brake": bases["hard_brake"]}, **FEW)
    assert found.ego == "Coasting"
    assert found.scenarios[0].report.estimate.p > 0.2


def test_the_spread_between_sites_widens_the_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sites whose rates differ by a factor r: the sd of the logarithm is log(r) / sqrt(2)."""
    brake = SCENARIOS["rare_envs/HardBrake-v0"]
    other = fitted_entries("hard_brake", shift=-0.4, provenance={"source": {"site": "another"}})
    scenario = replace(brake, bases={"us101": fitted_entries("hard_brake"), "i80": other})
    monkeypatch.setitem(SCENARIOS._entries, "rare_envs/HardBrake-v0", scenario)
    one = rare_envs.risk("idm", scenarios=("hard_brake",), **FEW)
    two = rare_envs.risk("idm", scenarios=("hard_brake",), sites=["us101", "i80"], **FEW)
    factor = two.scenarios[0].site_factors["i80"]
    assert one.scenarios[0].site_factors == {"i80": factor}
    assert one.total.rates[0].site_log_sd == 0.0
    assert two.total.rates[0].site_log_sd == pytest.approx(abs(math.log(factor)) / math.sqrt(2))
    assert two.total.interval_per_hour[1] > one.total.interval_per_hour[1]
    assert ", under i80 " in str(one)


REFUSED = {
    "counted twice": ({"scenarios": ("cut_in", "car_following")}, "count twice"),
    "site of one scenario alone": ({"sites": ("i80",), "bases": {}}, "hard_brake has no base of the site 'i80'"),
    "base of another scenario": ({"bases": {"highway": "x.json"}}, "highway"),
    "no frequency": ({"bases": {"cut_in": "highway"}}, "nobody counted"),
    "unknown option": ({"speed": 3}, "speed"),
}


@pytest.mark.parametrize(("changes", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_bad_input_is_one_line_before_any_simulation(
    bases: dict[str, str], monkeypatch: pytest.MonkeyPatch, changes: dict[str, object], said: str
) -> None:
    def simulated(*_: object) -> None:
        raise AssertionError("a simulation was started")

    monkeypatch.setattr(rare_envs.DrivingProblem, "evaluate", simulated)
    arguments = {"bases": bases, **FEW, **changes}
    with pytest.raises(BadInput, match=said) as refused:
        rare_envs.risk(arguments.pop("ego", "idm"), **arguments)
    assert "\n" not in str(refused.value)
