from __future__ import annotations

from typing import Any

from rare_envs.study.text import (
    describe_intervals,
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


def test_no_failure_is_said_with_what_it_leaves_possible() -> None:
    words = summarise_answer({**RESULT, "p": 0.0, "interval": [0.0, 0.001]}, "us101")
    assert words.startswith("None of 4,000 simulations ends in a collision; with 95 % confidence fewer than 1 in 1,000")
