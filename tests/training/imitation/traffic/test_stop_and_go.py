"""Stop-and-go scenes: leads keep their schedules, the rest stands where it can be driven from."""

import numpy as np
import torch

from training.data.trajectories import DT
from training.imitation.traffic.recording import stack_scenes
from training.imitation.traffic.replayed_traffic import start_replay
from training.imitation.traffic.stop_and_go import (
    DENSE_LANES,
    DENSE_ROWS,
    Wave,
    draw_wave,
    make_stop_and_go,
    speeds_of_wave,
)


def test_a_wave_waits_brakes_holds_and_speeds_up_again():
    speeds = speeds_of_wave(Wave(wait=1.0, braking=2.0, low=2.0, hold=3.0, acceleration=1.0), 10.0, 321)
    np.testing.assert_allclose(speeds[:11], 10.0)
    np.testing.assert_allclose(speeds[20], 8.0)  # after 1 s of braking
    np.testing.assert_allclose(speeds[50:81], 2.0)
    np.testing.assert_allclose(speeds[120], 6.0)
    np.testing.assert_allclose(speeds[160:320], speeds[:160])  # and again, every 16 s
    assert np.abs(np.diff(speeds) / DT).max() <= 2.0 + 1e-9


def test_two_of_five_waves_come_to_a_standstill():
    rng = np.random.default_rng(0)
    low = np.array([draw_wave(10.0, rng).low for _ in range(400)])
    assert 0.33 < (low == 0.0).mean() < 0.47
    assert low.max() <= 6.0


def test_all_but_the_first_of_each_lane_are_driven_and_none_touches_another():
    scenes = [make_stop_and_go(np.random.default_rng(seed)) for seed in range(5)]
    recording = stack_scenes(scenes)
    traffic = start_replay(recording, torch.arange(5), torch.zeros(5, dtype=torch.long))
    assert traffic.driven.sum(dim=1).tolist() == [DENSE_LANES * (DENSE_ROWS - 1)] * 5
    for scene in scenes:
        lead = np.isnan(scene.acceleration[0])
        assert lead.sum() == DENSE_LANES
        assert (scene.leads_lane()[0] == lead).all()
        gaps = np.diff(scene.x[0].reshape(DENSE_LANES, DENSE_ROWS), axis=1)
        assert gaps.min() > scene.length[0] + 1.9
        moved = scene.x[0, lead] + scene.speed[:-1, lead].sum(axis=0) * DT
        np.testing.assert_allclose(scene.x[-1, lead], moved)
        assert (scene.speed[:, lead].min(axis=0) < scene.speed[0, lead]).all()


def test_the_seed_decides():
    one, again, other = (make_stop_and_go(np.random.default_rng(seed)).x for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
