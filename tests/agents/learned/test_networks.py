"""The network: by hand, its 404 weights, and a last layer of its own for every scenario."""

import numpy as np
import pytest
import torch

from agents.learned.networks import (
    ACTION_SIZE,
    FEATURE_CLIP,
    FEATURE_SIZE,
    HEAD_SIZE,
    HIDDEN_SIZES,
    WEIGHT_NAMES,
    Policy,
    apply_heads,
    head_weights,
)
from tests.agents.learned.heads import replace_head


def test_the_last_layer_has_404_weights(policy):
    assert HEAD_SIZE == 404
    assert head_weights(policy).shape == (404,)
    assert sum(p.numel() for p in policy.parameters()) == 51 * 200 + 200 + 200 * 100 + 100 + 404


def test_forward_by_hand(policy, features):
    x = features(3, 2)
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


def test_features_far_out_are_clipped(policy):
    far = policy.scaling.feature_mean + 100.0 * policy.scaling.feature_std
    edge = policy.scaling.feature_mean + FEATURE_CLIP * policy.scaling.feature_std
    torch.testing.assert_close(policy.trunk(far), policy.trunk(edge))


def test_no_log_std_is_without_effect_or_over_the_cap(policy):
    output = torch.linspace(-8.0, 8.0, 33)[:, None].expand(-1, 2 * ACTION_SIZE).clone().requires_grad_()
    _, log_std = policy.split(output)
    assert bool((log_std < policy.log_std_cap).all())
    (slope,) = torch.autograd.grad(log_std.sum(), output)
    assert bool((slope[:, ACTION_SIZE:] > 0.0).all())


def test_new_networks_have_small_heads_and_quiet_noise(policy):
    mean, log_std = Policy(policy.scaling)(torch.zeros(1, FEATURE_SIZE))
    assert mean.abs().max() < 0.5
    assert bool(((log_std > -2.5) & (log_std < -0.5)).all())


def test_with_head_equals_a_loop_over_modules(policy, features, generator):
    x = features(6, 3)
    weights = head_weights(policy) + 0.1 * torch.randn(6, HEAD_SIZE, generator=generator)
    ours = apply_heads(policy.trunk(x), weights)
    theirs = torch.stack([(p := replace_head(policy, w)).head(p.trunk(row)) for w, row in zip(weights, x, strict=True)])
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0.0)


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
