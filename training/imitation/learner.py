"""The learner of GAIL and MGAIL: its critic, the state of a training, its rounds, and how it is saved and resumed.

The critic is a network that tells recorded driving from a policy's, by the features and the action of one moment.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from agents.learned.networks import ACTION_SIZE, FEATURE_SIZE, Policy
from rare_envs.files import replace_file
from training.imitation.clone import Pairs, log_likelihood, make_seeded, normalise_action
from training.imitation.config import Config
from training.imitation.rollout import RolloutSteps, ScenePool, draw_pool, roll_out
from training.imitation.traffic import Recording, Traffic

Log = dict[str, float]
POLICY_BETAS, CRITIC_BETAS = (0.9, 0.99), (0.5, 0.9)
"""Decay rates of Adam's two moments, for policy and critic."""
MAX_GRADIENT_NORM = 1.0
"""Norm to which the gradient of the policy is clipped."""
HIDDEN_UNITS, LEAK = 128, 0.2
"""Units of each hidden layer of critic and value, and the slope of the critic's activations below 0."""
_TRAINED_PARTS = ("policy", "critic", "value", "policy_optimiser", "critic_optimiser", "value_optimiser")
"""Attributes that have weights, or moments of an optimiser."""


def _network(activation: Callable[[], nn.Module]) -> nn.Sequential:
    """Return a network on features and actions: 53-128-128-1 units."""
    sizes = (FEATURE_SIZE + ACTION_SIZE, HIDDEN_UNITS, HIDDEN_UNITS)
    hidden = [layer for pair in pairwise(sizes) for layer in (nn.Linear(*pair), activation())]
    return nn.Sequential(*hidden, nn.Linear(HIDDEN_UNITS, 1))


class Critic(nn.Module):
    """Network of 53-128-128-1 units with LeakyReLU; its output is large where driving looks recorded."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = _network(lambda: nn.LeakyReLU(LEAK))

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


@dataclass
class Learner:
    """A training in progress; everything random comes from `generator`, so that a resumed one continues unchanged."""

    config: Config
    recording: Recording
    among: Tensor
    """Scenes that are driven, with repetition if they are bootstrapped, shape (k,)."""
    pairs: Pairs
    """Recorded driving for the critic and the likelihood."""
    policy: Policy
    critic: Critic
    generator: torch.Generator
    update: int = 0
    simulated: int = 0
    """Number of vehicle-steps so far."""

    def __post_init__(self) -> None:
        """Make optimisers, pools and the critic's memory."""
        config = self.config
        self.policy_optimiser = torch.optim.Adam(self.policy.parameters(), config.policy_rate, betas=POLICY_BETAS)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), config.critic_rate, betas=CRITIC_BETAS)
        self.value = make_seeded(lambda: _network(nn.Tanh), self.generator).to(self.device)
        self.value_optimiser = torch.optim.Adam(self.value.parameters(), config.value_rate)
        self.pools: list[ScenePool] = []
        self.rollouts: deque[Tensor] = deque(maxlen=config.memory)
        self.clone_pairs = self.pairs.features, normalise_action(self.policy, self.pairs.action)
        self.recorded = critic_inputs(self.policy, *self.clone_pairs)

    @property
    def device(self) -> torch.device:
        """Where traffic and networks are; numbers are drawn on the CPU, so that they are the same everywhere."""
        return self.recording.x.device

    def linear_schedule(self, ends: tuple[int, int]) -> int:
        """Return the value at this update of a linear schedule of whole numbers."""
        return round(ends[0] + (ends[1] - ends[0]) * self.config.share(self.update))

    def set_rates(self) -> None:
        """Set the learning rates of this update."""
        factor = self.config.rate_factor(self.update)
        rates = (self.policy_optimiser, self.config.policy_rate), (self.critic_optimiser, self.config.critic_rate)
        for optimiser, rate in rates:
            for group in optimiser.param_groups:
                group["lr"] = factor * rate

    def drive(self, credit: float) -> RolloutSteps:
        """Drive the next pool for a horizon; a pool that is too old is restarted from the record."""
        config = self.config
        while len(self.pools) < config.pools:
            self.pools.append(self._new_pool())
        index = self.update % config.pools
        if self.pools[index].age >= self.linear_schedule(config.age):
            self.pools[index] = self._new_pool()
        horizon = self.linear_schedule(config.horizon)
        steps, self.pools[index] = roll_out(
            self.recording, self.policy, self.pools[index], horizon, config.colour, credit, self.generator
        )
        self.simulated += len(steps.features)
        return steps

    def _new_pool(self) -> ScenePool:
        most, shortest = self.linear_schedule(self.config.drivers), self.linear_schedule(self.config.horizon)
        scenes, colour = self.config.scenes, self.config.colour
        return draw_pool(self.recording, self.among, scenes, most, shortest, colour, self.generator)

    def learn_critic(self, steps: RolloutSteps) -> float:
        """Make some steps on random pairs of the record, and of this and the last rollouts; return the last loss."""
        config, generator = self.config, self.generator
        self.rollouts.append(critic_inputs(self.policy, steps.features.detach(), steps.action.detach()))
        made = torch.cat(tuple(self.rollouts))
        loss = torch.zeros(())
        for _ in range(config.critic_steps):
            rows = torch.randint(len(self.recorded), (config.critic_batch,), generator=generator)
            other = torch.randint(len(made), (config.critic_batch,), generator=generator)
            loss = critic_loss(self.critic, self.recorded[rows], made[other], config.gradient_penalty, generator)
            self.critic_optimiser.zero_grad()
            torch.autograd.backward(loss)
            self.critic_optimiser.step()
        return float(loss.detach())

    def warm_up(self) -> None:
        """Train the critic before the policy moves."""
        for _ in range(self.config.warm_up):
            with torch.no_grad():
                steps = self.drive(1.0)
            self.learn_critic(steps)

    def clone_loss(self) -> Tensor:
        """Return the negative log likelihood of a batch of recorded actions."""
        features, action = self.clone_pairs
        rows = torch.randint(len(features), (self.config.batch,), generator=self.generator)
        mean, log_std = self.policy(features[rows])
        return -log_likelihood(mean, log_std, action[rows]).mean()

    def save(self, path: Path) -> None:
        """Write the state of the training."""
        state = {
            "update": self.update,
            "simulated": self.simulated,
            **{name: getattr(self, name).state_dict() for name in _TRAINED_PARTS},  # attributes by name
            "generator": self.generator.get_state(),
            "rollouts": list(self.rollouts),
            "pools": [{"traffic": pool.traffic._asdict(), "noise": pool.noise, "age": pool.age} for pool in self.pools],
        }
        with replace_file(path) as draft:
            torch.save(state, draft)

    def load(self, path: Path) -> None:
        """Resume a saved training.

        Raises:
            ValueError: The file is no checkpoint of such a training.
        """
        state = self.inherit(path)
        self.update, self.simulated = state["update"], state["simulated"]
        self.generator.set_state(state["generator"].cpu())
        self.rollouts.extend(state["rollouts"])
        self.pools = [ScenePool(Traffic(**pool["traffic"]), pool["noise"], pool["age"]) for pool in state["pools"]]

    def inherit(self, path: Path) -> dict[str, Any]:
        """Take over networks and optimisers of a saved training, but neither its progress nor its traffic.

        Returns:
            Content of the file.

        Raises:
            ValueError: The file is no checkpoint of such a training.
        """
        state: dict[str, Any] = torch.load(path, map_location=self.device, weights_only=True)
        if not state.keys() >= {"update", "pools", *_TRAINED_PARTS}:
            raise ValueError(f"Expected a checkpoint of a training in {str(path)!r}.")
        for name in _TRAINED_PARTS:
            getattr(self, name).load_state_dict(state[name])  # likewise
        return state


Update = Callable[[Learner], Log]


def run_updates(learner: Learner, update: Update) -> Iterator[Log]:
    """Make the remaining updates of a training, which may have been resumed, one by one; yield figures of each.

    Args:
        learner: The training.
        update: One round: drive, train the critic, change the policy.
    """
    if learner.update == 0:
        learner.warm_up()
    while learner.update < learner.config.updates:
        learner.set_rates()
        log = update(learner)
        learner.update += 1
        yield log
