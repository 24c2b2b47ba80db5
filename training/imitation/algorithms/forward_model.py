"""MGAIL's learned forward model: what a driver sees next, from what it sees and does.

As published, the simulator gives the value of the next features and the model their Jacobian:

    s' = f(s, a) + stop_gradient(s'_simulator - f(s, a)).

Only what depends on features and actions has a gradient then: the critic's cost, the likelihood of recorded actions
and the cost of hard braking. The costs of collision and of the road edge depend on the state, which the model does not
know, and lose theirs.

References:
    Baram, Anschel, Caspi and Mannor, "End-to-end differentiable adversarial imitation learning", ICML 2017.
"""

import torch
from torch import Tensor, nn

from agents.learned.networks import ACTION_SIZE, FEATURE_SIZE, Policy
from training.imitation.algorithms.critic import critic_inputs

_HIDDEN = 128


class ForwardModel(nn.Module):
    """53-128-128-51 tanh units, from normalised features and actions to the change of the normalised features."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(FEATURE_SIZE + ACTION_SIZE, _HIDDEN),
            nn.Tanh(),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.Tanh(),
            nn.Linear(_HIDDEN, FEATURE_SIZE),
        )

    def forward(self, policy: Policy, features: Tensor, action: Tensor) -> Tensor:
        """Features a tick later, (n, 51) in SI units, from features (n, 51) and normalised actions (n, 2)."""
        change: Tensor = self.layers(critic_inputs(policy, features, action))
        return features + policy.scaling.feature_std * change

    def substitute_gradient(self, policy: Policy, before: Tensor, action: Tensor, now: Tensor, credit: float) -> Tensor:
        """The features of now with the model's gradient to what was seen and done a tick before.

        Args:
            policy: Whose normalisation is used.
            before: Features a tick before, shape (B, M, 51).
            action: What was done then, normalised, shape (B, M, 2).
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
    """Some steps of least squares on a rollout.

    Args:
        model: What learns.
        optimiser: Of its weights.
        policy: Whose normalisation is used.
        features: Of T ticks, shape (T, n, 51), without gradient.
        action: Likewise, normalised, shape (T, n, 2).
        steps: Number of steps.
        batch: Moments of each.
        generator: Source of the moments.

    Returns:
        The last mean squared error, in units of the features' spreads.
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
