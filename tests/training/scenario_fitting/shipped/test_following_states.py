"""States of following of an instrumented car: a made-up record, and those behind the checks of `highway`."""

import json
from importlib import resources

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.training.shared_data import DATA, needs_data
from training.scenario_fitting.published_highway import build_highway_base
from training.scenario_fitting.shipped.following_states import (
    STATE_TICKS,
    check_against_following,
    load_following_states,
)
from training.scenario_fitting.shipped.new_leaders import CIRCLES_FILE


def test_states_are_apart_and_within_the_ranges(tmp_path):
    n = 6 * STATE_TICKS
    tick = np.arange(n)
    gap = np.where(tick < 2 * STATE_TICKS, 30.0, np.where(tick < 3 * STATE_TICKS, np.nan, 200.0))
    gap[4 * STATE_TICKS :] = 0.1 * tick[4 * STATE_TICKS :]
    rows = {"t": 0.1 * tick, "speed": np.full(n, 25.0), "gap": gap, "rel_speed": np.full(n, -2.0)}
    pq.write_table(pa.table({**rows, "radar": tick < 5 * STATE_TICKS}), tmp_path / CIRCLES_FILE)
    states = load_following_states(tmp_path)
    # twice at 30 m, then nobody, then 200 m, then 40 m, then no radar
    np.testing.assert_allclose(states, [[25.0, 23.0, 30.0], [25.0, 23.0, 30.0], [25.0, 23.0, 40.0]])
    checked = check_against_following(build_highway_base("car_following"), tmp_path)
    assert checked["provenance"]["checked_against"].startswith("3 states of following")
    assert {each["recorded"] for each in checked["provenance"]["checks"]} == {0}


@needs_data(CIRCLES_FILE)
def test_the_shipped_checks_are_those_of_the_recorded_states():
    file = resources.files("rare_envs") / "data" / "car_following_highway.json"
    shipped = json.loads(file.read_text(encoding="utf-8"))["provenance"]
    written = check_against_following(build_highway_base("car_following"), DATA)["provenance"]
    assert written["checked_against"] == shipped["checked_against"]
    for one, other in zip(written["checks"], shipped["checks"], strict=True):
        assert (one["name"], one["recorded"]) == (other["name"], other["recorded"])
        assert one["expected"] == pytest.approx(other["expected"], rel=0.01)
