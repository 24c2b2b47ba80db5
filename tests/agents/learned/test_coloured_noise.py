"""Coloured noise: its distribution in closed form and in samples."""

import math

import pytest
import torch

from agents.learned.networks import HUMAN_NOISE, AutoregressiveNoise

OSCILLATING = HUMAN_NOISE


def sequence(colour, ticks, n=100_000, seed=0):
    generator = torch.Generator().manual_seed(seed)
    memory = colour.begin(torch.randn(n, 2, 2, generator=generator))
    values = []
    for _ in range(ticks):
        value, memory = colour.step(memory, torch.randn(n, 2, generator=generator))
        values.append(value)
    return torch.stack(values)


def test_white_noise_is_the_fresh_draw():
    fresh = torch.randn(5, 2)
    value, _ = AutoregressiveNoise().step(AutoregressiveNoise().begin(torch.randn(5, 2, 2)), fresh)
    torch.testing.assert_close(value, fresh)


@pytest.mark.parametrize("colour", [OSCILLATING, AutoregressiveNoise((0.95, 0.5), (0.0, 0.0)), AutoregressiveNoise()])
def test_stationary_from_the_first_tick(colour):
    values = sequence(colour, 30)
    # the variance of n = 1e5 draws has a standard error of sqrt(2 / n) = 0.0045
    torch.testing.assert_close(values.var(dim=1), torch.ones(30, 2), atol=5 * 0.0045, rtol=0)


def test_autocorrelation_obeys_the_recursion():
    values = sequence(OSCILLATING, 21)
    for action, (a, b) in enumerate(zip(OSCILLATING.first, OSCILLATING.second, strict=True)):
        expected = [1.0, a / (1 - b)]
        for _ in range(19):
            expected.append(a * expected[-1] + b * expected[-2])
        for lag in (1, 5, 10, 20):
            found = float((values[0, :, action] * values[lag, :, action]).mean())
            assert found == pytest.approx(expected[lag], abs=5 / math.sqrt(100_000) * 1.5)


def test_swings_back():
    # half a period after a large value, a large one of the other sign is expected
    values = sequence(OSCILLATING, 21)
    assert float((values[0, :, 1] * values[20, :, 1]).mean()) < -0.4


def test_the_expected_part_is_known_before_the_draw():
    memory = OSCILLATING.begin(torch.randn(7, 2, 2, generator=torch.Generator().manual_seed(1)))
    value, after = OSCILLATING.step(memory, torch.zeros(7, 2))
    torch.testing.assert_close(value, OSCILLATING.predict_mean(memory))
    torch.testing.assert_close(after[..., 0], value)
    torch.testing.assert_close(after[..., 1], memory[..., 0])


def test_a_noise_that_grows_is_refused():
    with pytest.raises(ValueError, match="stationary"):
        AutoregressiveNoise((1.0, 0.5), (0.0, 0.0))


def test_balanced_noise_adds_up_to_nothing_but_what_is_fresh():
    noise = AutoregressiveNoise(OSCILLATING.first, OSCILLATING.second, balanced=True)
    memory = noise.begin(torch.randn(5, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    total = torch.zeros(5, 2, dtype=torch.float64)
    for _ in range(400):
        value, memory = noise.step(memory, torch.zeros(5, 2, dtype=torch.float64))
        total += value
    torch.testing.assert_close(total, torch.zeros_like(total), atol=1e-6, rtol=0)
    values = sequence(noise, 150)
    torch.testing.assert_close(values[-1].var(dim=0), torch.ones(2), atol=5 * 0.0045, rtol=0)


def test_balanced_noise_needs_two_lags():
    with pytest.raises(ValueError, match="Expected coefficients of lag 2 of a noise that begins balanced"):
        AutoregressiveNoise((0.9, 0.9), (0.0, 0.0), balanced=True)
