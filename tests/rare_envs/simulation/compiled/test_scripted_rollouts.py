"""Rollouts of many rows side by side against those of one row after the other: the same bits of f."""

import numpy as np
import pytest

import rare_envs
from rare_envs.control import IDM
from rare_envs.scenarios import straight
from rare_envs.scenarios.cut_in import CUTTER_IDM
from rare_envs.simulation.compiled import scripted_rollouts
from rare_envs.simulation.compiled.equations import IDMNumbers, RoadNumbers
from rare_envs.simulation.compiled.rows_side_by_side import ROWS, can_stand_side_by_side
from rare_envs.simulation.compiled.scripted_rollouts import LEAST_ROWS, drive_by_idm

SCRIPTS = {
    "car_following": "rare_envs/CarFollowing-v0",
    "hard_brake": "rare_envs/HardBrake-v0",
    "cut_in": "rare_envs/CutIn-v1",
}
EGOS = {
    "default": IDM(),
    "late": IDM(35.0, time_headway=0.3, max_deceleration=2.0, jam_distance_speed=0.0),
    "cut off": IDM(cut_off=True, added_length=2.0),
}


def anywhere(script: str, n: int) -> np.ndarray:
    """Scenarios from the whole physical box."""
    space = rare_envs.DrivingProblem(SCRIPTS[script]).space
    low, high = np.array(space.low), np.array(space.high)
    return low + (high - low) * np.random.default_rng(3).random((n, len(low)))


@pytest.mark.parametrize("n", [LEAST_ROWS, ROWS - 1, ROWS, ROWS + 1, 2_000])
@pytest.mark.parametrize("ego", EGOS.values(), ids=EGOS)
@pytest.mark.parametrize("script", SCRIPTS)
def test_f_has_the_bits_of_one_row_after_the_other(script, ego, n, monkeypatch):
    x, road = anywhere(script, n), straight(3)
    assert can_stand_side_by_side(*map(IDMNumbers.of, (ego, CUTTER_IDM)), road=RoadNumbers.of(road))
    together = drive_by_idm(script, x, ego, road, 0.1, 80)
    monkeypatch.setattr(scripted_rollouts, "can_stand_side_by_side", lambda *_, **__: False)
    alone = drive_by_idm(script, x, ego, road, 0.1, 80)
    np.testing.assert_array_equal(together, alone)
    assert n < 2_000 or 0.001 < (alone < 0).mean() < 0.9
