"""Behaviour cloning: maximum likelihood of recorded actions."""

from collections.abc import Callable, Iterator
from typing import TypeVar

import torch

from agents.learned.networks import Policy
from training.imitation.algorithms.actions import log_likelihood, normalise_action
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.expert_pairs import Pairs, scaling_of


def clone_policy(pairs: Pairs, config: Config, generator: torch.Generator) -> Policy:
    """Return a new policy that maximises the likelihood of recorded actions.

    Args:
        pairs: Recorded driving.
        config: Settings, of which `epochs`, `batch`, `clone_rate`, `weight_decay` and `log_std_cap` are used.
        generator: Source of the initial weights and of the order of the pairs.
    """
    policy = make_seeded(lambda: Policy(scaling_of(pairs), config.log_std_cap), generator).to(pairs.features.device)
    for _ in clone_epochs(policy, pairs, config, generator):
        pass
    return policy


def clone_epochs(policy: Policy, pairs: Pairs, config: Config, generator: torch.Generator) -> Iterator[None]:
    """Ascend the likelihood epoch by epoch, in those weights of the policy that require gradients.

    Few epochs are made: 51 features say little about the next action, and further epochs overfit.

    Yields:
        None after each epoch.
    """
    optimiser = torch.optim.Adam(policy.parameters(), lr=config.clone_rate, weight_decay=config.weight_decay)
    action = normalise_action(policy, pairs.action)
    for _ in range(config.epochs):
        order = torch.randperm(len(action), generator=generator)
        for rows in torch.split(order, config.batch):
            mean, log_std = policy(pairs.features[rows])
            loss = -log_likelihood(mean, log_std, action[rows]).mean()
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
        yield


Module = TypeVar("Module")


def make_seeded(make: Callable[[], Module], generator: torch.Generator) -> Module:
    """Return a network whose initial weights are drawn from a generator; PyTorch draws them from the global one."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        return make()
