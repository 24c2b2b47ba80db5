"""Learned forward model of MGAIL: a driver's next features from its features and its action.

As published, the simulator gives the value of the next features and the model their Jacobian:

    s' = f(s, a) + stop_gradient(s'_simulator - f(s, a)).

Then only what depends on features and actions has a gradient: the critic's cost, the likelihood of recorded actions
and the cost of hard braking. The costs of collision and of the road edge depend on the state, which the model does
not know, and lose theirs.

References:
    Baram, Anschel, Caspi and Mannor, "End-to-end differentiable adversarial imitation learning", ICML 2017.
"""

import torch
from torch import Tensor, nn

from agents.learned.networks import FEATURE_SIZE, Policy
from training.imitation.algorithms.critic import critic_inputs
from training.imitation.algorithms.layers import two_hidden_layers


class ForwardModel(nn.Module):
    """Network of 53-128-128-51 tanh units: normalised features and actions to the change of the features."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = two_hidden_layers(FEATURE_SIZE, nn.Tanh)

    def forward(self, policy: Policy, features: Tensor, action: Tensor) -> Tensor:
        """Return features a tick later, (n, 51) in SI units, from features (n, 51) and normalised actions (n, 2)."""
        change: Tensor = self.layers(critic_inputs(policy, features, action))
        return features + policy.scaling.feature_std * change

    def substitute_gradient(self, policy: Policy, before: Tensor, action: Tensor, now: Tensor, credit: float) -> Tensor:
        """Return the current features with the model's gradient to features and actions a tick before.

        Args:
            policy: Policy whose normalisation is used.
            before: Features a tick before, shape (B, M, 51).
            action: Normalised actions a tick before, shape (B, M, 2).
            now: Features that the simulator gives, shape (B, M, 51).
            credit: Share of the gradient that is passed on.
        """
        guess: Tensor = credit * self(policy, before.flatten(0, 1), action.flatten(0, 1)).view_as(now)
        return guess + (now - guess).detach()


def train_model(
    model: ForwardModel,
    optimiser: torch.optim.Optimizer,
    policy: Policy,
    features: Tensor,
    action: Tensor,
    steps: int,
    batch: int,
    generator: torch.Generator,
) -> float:
    """Make some steps of least squares on a rollout.

    Args:
        model: The model.
        optimiser: Optimiser of its weights.
        policy: Policy whose normalisation is used.
        features: Features of T ticks, shape (T, n, 51), without gradient.
        action: Normalised actions, shape (T, n, 2).
        steps: Number of steps.
        batch: Moments in a step.
        generator: Source of the choice of moments.

    Returns:
        The last mean squared error, in units of the features' standard deviations.
    """
    before, done, after = features[:-1].flatten(0, 1), action[:-1].flatten(0, 1), features[1:].flatten(0, 1)
    error = torch.zeros(())
    for _ in range(steps):
        rows = torch.randint(len(before), (batch,), generator=generator)
        off = (model(policy, before[rows], done[rows]) - after[rows]) / policy.scaling.feature_std
        error = off.square().mean()
        optimiser.zero_grad()
        torch.autograd.backward(error)
        optimiser.step()
    return float(error.detach())
