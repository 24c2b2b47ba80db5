"""Tracks of 25 Hz at the ticks of a table: polynomials are kept, holes are cut, ends are not overrun."""

import numpy as np

from training.data.formats.resampling import resample_tracks


def test_cubics_and_lines_are_exact_and_holes_are_cut():
    frames = np.concatenate([np.arange(3, 40), np.arange(52, 80)])  # at 25 Hz, frames 40 to 51 are missing
    time = 0.04 * frames
    position = np.column_stack([1.0 + 20.0 * time - time**3, 2.0 * time])
    speed = (20.0 - 1.5 * time)[:, None]
    order = np.random.default_rng(0).permutation(len(time))
    rows = resample_tracks(np.full(len(time), 7.0), time[order], 0.04, position[order], speed[order])
    # 0.12 to 1.56 s and 2.08 to 3.16 s
    assert rows.frame.tolist() == [*range(2, 16), *range(21, 32)]
    t = 0.1 * rows.frame
    np.testing.assert_allclose(rows.splined, np.column_stack([1.0 + 20.0 * t - t**3, 2.0 * t]), atol=1e-9)
    np.testing.assert_allclose(rows.linear[:, 0], 20.0 - 1.5 * t, atol=1e-9)
    assert (np.abs(time[order][rows.nearest] - t) <= 0.02 + 1e-9).all()
    assert set(rows.vehicle) == {7.0}


def test_a_track_between_two_ticks_has_no_rows():
    time = np.array([0.12, 0.16, 1.0, 1.04])
    values = np.arange(4.0)[:, None]
    rows = resample_tracks(np.array([1.0, 1.0, 2.0, 2.0]), time, 0.04, values, values)
    assert rows.vehicle.tolist() == [2.0] and rows.frame.tolist() == [10.0]
