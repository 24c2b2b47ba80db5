"""The compact tables of NGSIM: sizes of the recorded ones, and errors."""

import numpy as np
import pytest

from tests.training.shared_data import DATA, needs_data
from training.data.ngsim_tables import (
    PAIRS_FILE,
    SCENES_FILE,
    VEHICLES_FILE,
    load_i80_pairs,
    load_us101_trajectories,
    load_us101_vehicles,
)
from training.data.trajectories import NOBODY


@needs_data(SCENES_FILE, VEHICLES_FILE, PAIRS_FILE)
def test_compact_tables_load():
    scenes, vehicles, pairs = load_us101_trajectories(DATA), load_us101_vehicles(DATA), load_i80_pairs(DATA)
    assert [len(scenes), len(vehicles), len(pairs)] == [54_336, 214_267, 110_905]
    assert len(load_us101_trajectories(DATA, merged=False)) == 65_686
    assert len(set(vehicles.vehicle)) == 370
    assert np.isnan(vehicles.length).all()
    following = pairs.leader != NOBODY
    assert following.sum() == 68_339
    assert (pairs.find_rows(pairs.leader)[following] >= 0).all()


def test_a_missing_compact_table_is_named(tmp_path):
    with pytest.raises(ValueError, match=PAIRS_FILE):
        load_i80_pairs(tmp_path)
