"""The critic: tells recorded driving from a policy's by what is seen and done in one moment."""

from collections import deque

import torch
from torch import Tensor, nn

from agents.learned.networks import ACTION_SIZE, FEATURE_SIZE, Policy

_HIDDEN = 128


class Critic(nn.Module):
    """53-128-128-1, LeakyReLU; large where driving looks recorded."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(FEATURE_SIZE + ACTION_SIZE, _HIDDEN),
            nn.LeakyReLU(0.2),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.LeakyReLU(0.2),
            nn.Linear(_HIDDEN, 1),
        )

    def forward(self, pairs: Tensor) -> Tensor:
        """Pairs (n, 53), see `critic_inputs`, to logits (n,)."""
        logits: Tensor = self.layers(pairs)[:, 0]
        return logits


def critic_inputs(policy: Policy, features: Tensor, action: Tensor) -> Tensor:
    """What the critic sees: normalised features (n, 51) beside normalised actions (n, 2)."""
    return torch.cat((policy.normalise(features), action), dim=1)


def policy_cost(critic: Critic, pairs: Tensor) -> Tensor:
    """-log of the probability that a pair is recorded, softplus(-logit), shape (n,).

    GAIL's paper minimises log(1 - D) for D the probability of being the policy's; in our sign, D of being recorded,
    -log D keeps a gradient where the policy is easily told, as in the papers' code.
    """
    return nn.functional.softplus(-critic(pairs))


def critic_loss(critic: Critic, recorded: Tensor, made: Tensor, penalty: float, generator: torch.Generator) -> Tensor:
    """Logistic loss with a penalty on the gradient between recorded and made pairs, (n, 53) each.

    The penalty is on the mean squared norm itself, not on its distance to 1 as in WGAN-GP: with a logistic loss there
    is no reason for a slope of 1.
    """
    share = torch.rand(len(recorded), 1, generator=generator)
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
    """Some steps on random pairs of the record and of the last rollouts.

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
