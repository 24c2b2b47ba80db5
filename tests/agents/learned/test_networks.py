"""The network by hand and its 404 weights; its noise in closed form and in samples."""

import math

import numpy as np
import pytest
import torch

from agents.learned.networks import (
    ACTION_SIZE,
    FEATURE_CLIP,
    HEAD_SIZE,
    HIDDEN_SIZES,
    HUMAN_NOISE,
    WEIGHT_NAMES,
    AutoregressiveNoise,
    head_weights,
)
from tests.agents.learned.heads import replace_head


def test_forward_by_hand(policy, features):
    x = 5.0 * features(3, 2)  # some are clipped
    mean, log_std = policy(x)

    arrays = {name: value.double().numpy() for name, value in policy.state_dict().items()}
    z = (x.double().numpy() - arrays["feature_mean"]) / arrays["feature_std"]
    z = np.clip(z, -FEATURE_CLIP, FEATURE_CLIP)
    for layer in ("first", "second"):
        z = np.tanh(z @ arrays[f"{layer}.weight"].T + arrays[f"{layer}.bias"])
    out = z @ arrays["head.weight"].T + arrays["head.bias"]
    np.testing.assert_allclose(mean.numpy(), out[..., :2], atol=1e-5)
    cap = arrays["log_std_cap"]
    np.testing.assert_allclose(log_std.numpy(), cap - np.log1p(np.exp(cap - out[..., 2:])), atol=1e-5)


def test_no_log_std_is_without_effect_or_over_the_cap(policy):
    output = torch.linspace(-8.0, 8.0, 33)[:, None].expand(-1, 2 * ACTION_SIZE).clone().requires_grad_()
    _, log_std = policy.split(output)
    assert bool((log_std < policy.log_std_cap).all())
    (slope,) = torch.autograd.grad(log_std.sum(), output)
    assert bool((slope[:, ACTION_SIZE:] > 0.0).all())


@pytest.mark.parametrize("name", ["mean_acceleration_0", "mean_yaw_rate_99", "log_std_acceleration_bias"])
def test_names_are_in_the_order_of_the_weights(policy, name):
    """Changing the weight of a name changes the output and the unit that it names."""
    output, unit = name.rsplit("_", 1)
    row = ["mean_acceleration", "mean_yaw_rate", "log_std_acceleration", "log_std_yaw_rate"].index(output)
    weights = head_weights(policy)
    weights[WEIGHT_NAMES.index(name)] += 1.0
    changed = replace_head(policy, weights)
    weight, bias = changed.head.weight - policy.head.weight, changed.head.bias - policy.head.bias
    assert len(WEIGHT_NAMES) == len(set(WEIGHT_NAMES)) == HEAD_SIZE
    assert torch.cat((weight, bias[:, None]), dim=1).count_nonzero() == 1
    assert torch.cat((weight, bias[:, None]), dim=1)[row, HIDDEN_SIZES[-1] if unit == "bias" else int(unit)] != 0.0


# --- noise ---------------------------------------------------------------------------------------


def sequence(colour, ticks, n=100_000, seed=0):
    generator = torch.Generator().manual_seed(seed)
    memory = colour.begin(torch.randn(n, 2, 2, generator=generator))
    values = []
    for _ in range(ticks):
        value, memory = colour.step(memory, torch.randn(n, 2, generator=generator))
        values.append(value)
    return torch.stack(values)


@pytest.mark.parametrize("colour", [HUMAN_NOISE, AutoregressiveNoise((0.95, 0.5), (0.0, 0.0)), AutoregressiveNoise()])
def test_stationary_from_the_first_tick(colour):
    values = sequence(colour, 30)
    # the variance of n = 1e5 draws has a standard error of sqrt(2 / n) = 0.0045
    torch.testing.assert_close(values.var(dim=1), torch.ones(30, 2), atol=5 * 0.0045, rtol=0)


def test_autocorrelation_obeys_the_recursion():
    values = sequence(HUMAN_NOISE, 21)
    for action, (a, b) in enumerate(zip(HUMAN_NOISE.first, HUMAN_NOISE.second, strict=True)):
        expected = [1.0, a / (1 - b)]
        for _ in range(19):
            expected.append(a * expected[-1] + b * expected[-2])
        for lag in (1, 5, 10, 20):
            found = float((values[0, :, action] * values[lag, :, action]).mean())
            assert found == pytest.approx(expected[lag], abs=5 / math.sqrt(100_000) * 1.5)


def test_balanced_noise_adds_up_to_nothing_but_what_is_fresh():
    noise = AutoregressiveNoise(HUMAN_NOISE.first, HUMAN_NOISE.second, balanced=True)
    memory = noise.begin(torch.randn(5, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    total = torch.zeros(5, 2, dtype=torch.float64)
    for _ in range(400):
        value, memory = noise.step(memory, torch.zeros(5, 2, dtype=torch.float64))
        total += value
    torch.testing.assert_close(total, torch.zeros_like(total), atol=1e-6, rtol=0)
    values = sequence(noise, 150)
    torch.testing.assert_close(values[-1].var(dim=0), torch.ones(2), atol=5 * 0.0045, rtol=0)


def test_noises_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="stationary"):
        AutoregressiveNoise((1.0, 0.5), (0.0, 0.0))
    with pytest.raises(ValueError, match="Expected coefficients of lag 2 of a noise that begins balanced"):
        AutoregressiveNoise((0.9, 0.9), (0.0, 0.0), balanced=True)
