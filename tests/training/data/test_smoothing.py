"""Smoothing against its transfer function, and exact replay of the actions."""

import numpy as np
import pytest

from training.data.smoothing import MIN_HEADING_SPEED, infer_motion, resample_tracks, smooth_positions
from training.data.table import DT


def replayed(track, x, y):
    """The simulator's step: explicit Euler, old values."""
    heading, speed, acceleration, yaw_rate = track
    states = [(x[0], y[0], heading[0], speed[0])]
    for a, w in zip(acceleration[:-2], yaw_rate[:-2], strict=True):
        px, py, h, v = states[-1]
        states.append((px + v * np.cos(h) * DT, py + v * np.sin(h) * DT, h + w * DT, v + a * DT))
    return np.array(states)


def test_parabolas_pass_unchanged():
    t = DT * np.arange(80)
    positions = 3.0 + 12.0 * t - 0.7 * t**2
    np.testing.assert_allclose(smooth_positions(positions, 0.4, DT), positions, atol=1e-6)


@pytest.mark.parametrize("frequency", [0.1, 0.4, 0.8])
def test_gain_of_a_wave_is_that_of_the_filter(frequency):
    t = DT * np.arange(2000)
    wave = np.sin(2.0 * np.pi * frequency * t)
    gain = 1.0 / (1.0 + ((1 - np.cos(2 * np.pi * frequency * DT)) / (1 - np.cos(2 * np.pi * 0.4 * DT))) ** 3)
    middle = slice(500, 1500)
    np.testing.assert_allclose(smooth_positions(wave, 0.4, DT)[middle], gain * wave[middle], atol=1e-6)


def test_short_tracks_come_back_and_holes_are_refused():
    assert smooth_positions(np.array([1.0, 5.0, 2.0]), 0.4, DT).tolist() == [1.0, 5.0, 2.0]
    with pytest.raises(ValueError, match="cut the track"):
        smooth_positions(np.array([1.0, np.nan, 2.0, 3.0]), 0.4, DT)
    with pytest.raises(ValueError, match="cut-off"):
        smooth_positions(np.zeros(9), 6.0, DT)


def test_replaying_the_actions_gives_the_track():
    t = DT * np.arange(60)
    x, y = 10.0 * t + np.sin(t), 3.5 / (1.0 + np.exp(3.0 - t))
    states = replayed(infer_motion(x, y, DT), x, y)
    np.testing.assert_allclose(states[:, 0], x[:-1], atol=1e-10)
    np.testing.assert_allclose(states[:, 1], y[:-1], atol=1e-10)


def test_a_creeping_vehicle_does_not_spin():
    jitter = 0.02 * np.random.default_rng(0).standard_normal((2, 50))
    heading, speed, *_ = infer_motion(np.cumsum(jitter[0]), jitter[1], DT)
    assert np.nanmin(speed) >= 0.0
    assert np.nanmax(np.abs(heading)) <= np.arctan2(1.5, MIN_HEADING_SPEED)


def test_cubics_and_lines_are_exact_and_holes_are_cut():
    frames = np.concatenate([np.arange(3, 40), np.arange(52, 80)])  # at 25 Hz, frames 40 to 51 are missing
    time = 0.04 * frames
    order = np.random.default_rng(0).permutation(len(time))
    cubic, line = (1.0 + 20.0 * time - time**3)[order], (20.0 - 1.5 * time)[order]
    rows, nearest = resample_tracks(np.full(len(time), 7.0), time[order], 0.04, {"x": cubic}, {"speed": line})
    # 0.12 to 1.56 s and 2.08 to 3.16 s
    assert rows["frame"].tolist() == [*range(2, 16), *range(21, 32)]
    t = 0.1 * rows["frame"]
    np.testing.assert_allclose(rows["x"], 1.0 + 20.0 * t - t**3, atol=1e-9)
    np.testing.assert_allclose(rows["speed"], 20.0 - 1.5 * t, atol=1e-9)
    assert (np.abs(time[order][nearest] - t) <= 0.02 + 1e-9).all()
    assert set(rows["vehicle"]) == {7.0}


def test_a_track_between_two_ticks_has_no_rows():
    time, values = np.array([0.12, 0.16, 1.0, 1.04]), {"x": np.arange(4.0)}
    rows, _ = resample_tracks(np.array([1.0, 1.0, 2.0, 2.0]), time, 0.04, values, {})
    assert rows["vehicle"].tolist() == [2.0] and rows["frame"].tolist() == [10.0]
