"""The critic: a network that tells recorded driving from a policy's, by the features and the action of one moment."""

from collections import deque

import torch
from torch import Tensor, nn

from agents.learned.networks import Policy
from training.imitation.algorithms.layers import two_hidden_layers

LEAK = 0.2
"""Slope of the activations below 0."""


class Critic(nn.Module):
    """Network of 53-128-128-1 units with LeakyReLU; its output is large where driving looks recorded."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = two_hidden_layers(1, lambda: nn.LeakyReLU(LEAK))

    def forward(self, pairs: Tensor) -> Tensor:
        """Return the logits (n,) of pairs (n, 53), see `critic_inputs`."""
        logits: Tensor = self.layers(pairs)[:, 0]
        return logits


def critic_inputs(policy: Policy, features: Tensor, action: Tensor) -> Tensor:
    """Return the critic's input: normalised features (n, 51) beside normalised actions (n, 2)."""
    return torch.cat((policy.normalise(features), action), dim=1)


def policy_cost(critic: Critic, pairs: Tensor) -> Tensor:
    """Return -log of the probability that a pair is recorded, softplus(-logit), shape (n,).

    GAIL's paper minimises log(1 - D), where D is the probability that the pair is the policy's. In our sign D is
    that of being recorded, and -log D keeps a gradient where the policy is easily recognised, as in the code of the
    papers.
    """
    return nn.functional.softplus(-critic(pairs))


def critic_loss(critic: Critic, recorded: Tensor, made: Tensor, penalty: float, generator: torch.Generator) -> Tensor:
    """Return the logistic loss with a penalty on the gradient between recorded and made pairs, (n, 53) each.

    The penalty is on the mean squared norm itself, not on its distance to 1 as in WGAN-GP: with a logistic loss
    nothing favours a slope of 1.
    """
    share = torch.rand(len(recorded), 1, generator=generator).to(recorded.device)
    between = (share * recorded + (1.0 - share) * made).requires_grad_(True)
    (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
    told = nn.functional.softplus(-critic(recorded)).mean() + nn.functional.softplus(critic(made)).mean()
    return told + penalty * slope.square().sum(dim=1).mean()


def train_critic(
    critic: Critic,
    optimiser: torch.optim.Optimizer,
    recorded: Tensor,
    rollouts: deque[Tensor],
    steps: int,
    batch: int,
    penalty: float,
    generator: torch.Generator,
) -> float:
    """Make some steps on random pairs of the record and of the last rollouts.

    Args:
        critic: The critic.
        optimiser: Optimiser of its weights.
        recorded: Pairs of the record, shape (n, 53).
        rollouts: Pairs of the last rollouts, shape (m, 53) each.
        steps: Number of steps.
        batch: Pairs of each kind in a step.
        penalty: Weight of the penalty on the gradient.
        generator: Source of the choice of pairs.

    Returns:
        The last loss.
    """
    made = torch.cat(tuple(rollouts))
    loss = torch.zeros(())
    for _ in range(steps):
        rows = torch.randint(len(recorded), (batch,), generator=generator)
        other = torch.randint(len(made), (batch,), generator=generator)
        loss = critic_loss(critic, recorded[rows], made[other], penalty, generator)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
    return float(loss.detach())
