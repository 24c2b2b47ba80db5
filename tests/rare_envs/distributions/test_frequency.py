"""Frequencies by pencil and paper, their error against simulated counts, and what is refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rare_envs.distributions.fitted import EventFrequency, read_record

CUT_INS = EventFrequency(
    count=1221,
    hours=112.0,
    km=3900.0,
    share=38 / 46,
    share_events=46,
    definition="lane changes ahead of a vehicle",
    source="NGSIM US 101, complete",
)


def test_rates_by_hand() -> None:
    """10.90 cut-ins per hour times 0.826: 9.0; 0.313 per km times 0.826: 0.26."""
    assert CUT_INS.per_hour == pytest.approx(1221 * 38 / (112 * 46), rel=1e-14)
    assert (round(CUT_INS.per_hour, 2), round(CUT_INS.per_km, 3)) == (9.01, 0.259)


def test_error_by_hand() -> None:
    """1 / 1221 + 1 / 38 - 1 / 46 = 0.000819 + 0.026316 - 0.021739 = 0.005396."""
    assert CUT_INS.log_sd**2 == pytest.approx(1 / 1221 + 1 / 38 - 1 / 46, rel=1e-12)
    assert CUT_INS.log_sd == pytest.approx(0.07346, abs=5e-6)
    assert replace(CUT_INS, share_events=None).log_sd == pytest.approx(1221**-0.5, rel=1e-12)
    assert replace(CUT_INS, share=1.0, count=16).log_sd == pytest.approx(0.25, rel=1e-12)


def test_error_is_that_of_counts_drawn_anew() -> None:
    """Poisson counts and binomial shares; second-order terms are 2 % of the deviation, its own error 0.5 %."""
    rng, n = np.random.default_rng(0), 20_000
    logs = np.log(rng.poisson(1221, n)) + np.log(rng.binomial(46, 38 / 46, n) / 46)
    assert logs.std() == pytest.approx(CUT_INS.log_sd, rel=0.04)


def test_dictionary_round_trip() -> None:
    assert read_record(EventFrequency, "frequency", CUT_INS.to_dict()) == CUT_INS
    assert CUT_INS.to_dict()["share_events"] == 46


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "count of the frequency as a whole number, 1 or more, got 0"),
        ({"count": 3.5}, r"count of the frequency .* got 3\.5"),
        ({"count": True}, "got True"),
        ({"hours": -1.0}, "hours of the frequency as a number above 0, got -1.0"),
        ({"hours": "many"}, "hours of the frequency as a number above 0, got 'many'"),
        ({"km": float("nan")}, "km of the frequency as a number above 0, got nan"),
        ({"km": float("inf")}, "km of the frequency as a number above 0, got inf"),
        ({"share": 0.0}, "share of the frequency as a number above 0, at most 1, got 0.0"),
        ({"share": 1.2}, "at most 1, got 1.2"),
        ({"share_events": 0}, "share_events of the frequency as a whole number"),
        ({"definition": ""}, "definition of the frequency as a text, got ''"),
        ({"source": None}, "source of the frequency as a text, got None"),
    ],
)
def test_bad_values_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CUT_INS, **change)
