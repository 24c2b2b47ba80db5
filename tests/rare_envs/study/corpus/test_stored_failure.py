"""Stored failures: read back as they were, and refused in one line when they are not what was written."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rare_envs.study.arguments import Question
from rare_envs.study.corpus import (
    WORLD_FIELDS,
    make_stored,
    parse_stored,
    read_stored,
)

QUESTION = Question(env_id="rare_envs/CarFollowing-v0", horizon=4.0, gamma=0.5, ego="mine:make")
X = {"ego_speed": np.array(20.1), "lead_speed": np.array(5.0 / 3.0), "gap": np.array(10.0)}
STORED = make_stored(QUESTION, X, f=-1.0, log_p0=-9.25, crash="rear_end")


def test_it_comes_back_to_the_bit() -> None:
    again = parse_stored(STORED.to_json(), "the file")
    assert again == STORED and again.x["lead_speed"] == [5.0 / 3.0]
    nan = replace(STORED, f=math.nan)
    assert math.isnan(parse_stored(nan.to_json(), "the file").f)


def test_its_key_is_that_of_the_scenario_alone() -> None:
    assert replace(STORED, ego="idm", f=0.0, crash="", versions=None).key == STORED.key
    other = {**STORED.x, "gap": [10.000001]}
    assert replace(STORED, x=other).key != STORED.key
    assert replace(STORED, world={**STORED.world, "horizon": 5.0}).key != STORED.key
    assert set(STORED.world) == set(WORLD_FIELDS)


def change(content: dict[str, Any], **values: Any) -> str:
    return json.dumps({**content, **values})


@pytest.mark.parametrize(
    "values",
    [
        {"format": 2},
        {"sha256": "0" * 64},
        {"x": {**STORED.x, "gap": [3.0]}},  # changed after it was stored
        {"x": {**STORED.x, "gap": ["3"]}},
        {"x": []},
        {"env_id": 3},
        {"base": 7},
        {"world": {}},
        {"world": {**STORED.world, "gamma": "low"}},
        {"f": "NaN"},
    ],
)
def test_what_was_changed_is_refused(values: dict[str, Any]) -> None:
    content = json.loads(STORED.to_json())
    with pytest.raises(ValueError, match="the file") as refused:
        parse_stored(change(content, **values), "the file")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, '{"format": 1}', '{"format": 1e400}'])
def test_other_files_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="the file"):
        parse_stored(text, "the file")


def test_two_hundred_damaged_files_are_refused_or_the_same(tmp_path: Any) -> None:
    """A byte changed anywhere: the scenario is either untouched or the file is refused."""
    text = STORED.to_json().encode()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(200):
        damaged = bytearray(text)
        damaged[rng.integers(len(text))] = rng.integers(256)
        (tmp_path / "a.json").write_bytes(damaged)
        try:
            assert read_stored(tmp_path / "a.json").digest == STORED.digest
        except ValueError:
            refused += 1
    assert refused > 50
