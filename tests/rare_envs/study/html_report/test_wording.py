from __future__ import annotations

from typing import Any

import pytest

from rare_envs.study.text import (
    describe_intervals,
    describe_rate,
    describe_validity,
    explain_no_gain,
    format_odds,
    summarise_answer,
)

RESULT: dict[str, Any] = {
    "p": 0.0012,
    "interval": [0.00085, 0.0018],
    "confidence": 0.95,
    "gamma": 0.0,
    "n_sim": 4000,
    "question": {"env_id": "rare_envs/CutIn-v0", "measure": "ttc"},
}


def test_both_intervals_are_written_as_p_is() -> None:
    base = {"interval": [1.1e-4, 0.014], "confidence": 0.95, "fitted_to": "38 events", "expected": 0.0023}
    sampling, other = describe_intervals({**RESULT, "base_uncertainty": base})
    assert sampling[:2] == ("95 %, sampling", "0.085 % to 0.18 %")
    assert other[:2] == ("95 %, base distribution", "0.011 % to 1.4 %") and "38 events" in other[2]
    assert len(describe_intervals(RESULT)) == 1


def test_an_interval_that_the_events_do_not_determine_is_said_to_be_so() -> None:
    base = {"interval": [None, None], "confidence": None, "fitted_to": "3 events", "expected": None}
    assert describe_intervals({**RESULT, "base_uncertainty": base})[1][1] == "not determined"


def test_no_failure_is_said_with_what_it_leaves_possible() -> None:
    words = summarise_answer({**RESULT, "p": 0.0, "interval": [0.0, 0.001]}, "us101")
    assert words.startswith("None of 4,000 simulations ends in a collision; with 95 % confidence fewer than 1 in 1,000")


def test_failures_of_a_search_that_count_for_nothing_are_not_denied() -> None:
    result = {**RESULT, "p": 0.0, "interval": [0.0, 0.001], "n_failures": 3, "base_draws": 600, "unseen": 0.005}
    words = summarise_answer(result, "us101")
    assert words.startswith("Of 4,000 simulations 3 found what ends in a collision, but none of those counts in p")
    assert (
        "600 draws of ordinary traffic would have met one with probability above 0.5 % (95 % confidence)"
        in describe_validity(result)
    )
    nothing = describe_validity({**result, "n_failures": 0})
    assert nothing.startswith("none of 600 draws of ordinary traffic failed, so p is below 0.5 % with 95 % confidence")
    assert "valid if no failure region was missed; " in describe_validity({**result, "p": 0.0012, "n_failures": 0})
    assert "no draws of ordinary traffic limit its" in describe_validity(RESULT)


@pytest.mark.parametrize(
    ("p", "words"), [(0.5, "about 50 in 100"), (0.0123, "about 1 in 81"), (2.7e-6, "about 1 in 370,000")]
)
def test_odds(p: float, words: str) -> None:
    assert format_odds(p) == words


def test_a_rate_or_why_there_is_none() -> None:
    assert describe_rate({"no_rate": "no events were counted"}) == ["no events were counted"]
    rate = {"per_million_km": 320.0, "interval_per_million_km": [29.0, 3500.0], "per_hour": 0.011}
    lines = describe_rate({"rate": {**rate, "interval_per_hour": [0.001, 0.12]}})
    assert lines[0].startswith("320 collisions per million km (29 to 3,500), 0.011 per hour")


def test_the_limit_of_a_gate_explains_the_confidence() -> None:
    (sampling,) = describe_intervals({**RESULT, "confidence": 0.9, "gate": {"decision": "passes"}})
    assert sampling[0] == "90 %, sampling" and sampling[2].endswith(
        "each end is one-sided at 95 %, for the limit of --max-p"
    )
    assert "--max-p" not in describe_intervals({**RESULT, "gate": None})[0][2]


def test_no_gain_has_a_reason() -> None:
    assert len({explain_no_gain(p) for p in (0.0, 0.5, 1.0)}) == 3
