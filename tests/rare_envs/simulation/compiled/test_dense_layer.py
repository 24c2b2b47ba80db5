"""Compiled layers against NumPy, and the order of their sums."""

import numpy as np
import pytest

from rare_envs.compilation import compiled_fused
from rare_envs.simulation.compiled.dense_layer import STRIP, UNITS_AT_ONCE, apply_layer


@compiled_fused
def apply_row_by_row(weight, bias, before, after):
    """Add the products of one row after the other, in the order of the inputs."""
    for lane in range(before.shape[1]):
        for output in range(len(weight)):
            total = bias[output]
            for number in range(weight.shape[1]):
                total = total + weight[output, number] * before[number, lane]
            after[output, lane] = total


def layer(outputs: int, inputs: int, lanes: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.normal(size=size).astype(np.float32) for size in ((outputs, inputs), outputs, (inputs + 2, lanes))]


@pytest.mark.parametrize(
    ("outputs", "inputs", "lanes"),
    [(UNITS_AT_ONCE, 1, STRIP), (24, 7, 2 * STRIP), (104, 200, 4 * STRIP), (8, 0, STRIP)],
)
def test_outputs(outputs, inputs, lanes):
    weight, bias, before = layer(outputs, inputs, lanes)
    after = np.full((outputs + 1, lanes), 7.0, np.float32)
    apply_layer(weight, bias, before, after)
    expected = weight.astype(float) @ before[:inputs].astype(float) + bias[:, None]
    assert np.allclose(after[:-1], expected, rtol=0.0, atol=1e-4)  # sums of 200 terms, up to 50
    assert (after[-1] == 7.0).all()  # beyond the outputs nothing is written
    plain = np.empty((outputs, lanes), np.float32)
    apply_row_by_row(weight, bias, before, plain)
    assert np.array_equal(after[:-1], plain)


def test_what_is_not_finite_stays_in_its_row():
    weight, bias, before = layer(UNITS_AT_ONCE, 9, STRIP)
    expected, after = (np.empty((UNITS_AT_ONCE, STRIP), np.float32) for _ in range(2))
    apply_layer(weight, bias, before, expected)
    before[4, 5], before[2, 8] = np.nan, np.inf
    apply_layer(weight, bias, before, after)
    wrong = ~np.isfinite(after).all(0)
    assert np.flatnonzero(wrong).tolist() == [5, 8]
    assert np.array_equal(after[:, ~wrong], expected[:, ~wrong])
