"""Networks with other last layers, for comparing."""

import copy

import torch

from agents.learned.networks import Policy


def replace_head(policy: Policy, weights: torch.Tensor) -> Policy:
    """Return a copy of a network with other weights (404,) in its last layer, as `head_weights` has them."""
    changed, layer = copy.deepcopy(policy), weights.detach().view(4, 101)
    changed.head.weight.data, changed.head.bias.data = layer[:, :-1].clone(), layer[:, -1].clone()
    return changed
