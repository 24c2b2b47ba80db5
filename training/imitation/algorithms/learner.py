"""The learner of GAIL and MGAIL: the state of a training, its rounds, and how it is saved and resumed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from agents.learned.networks import Policy
from rare_envs.files import replace_file
from training.imitation.algorithms.actions import log_likelihood, normalise_action
from training.imitation.algorithms.behaviour_cloning import make_seeded
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.critic import Critic, critic_inputs, train_critic
from training.imitation.algorithms.expert_pairs import Pairs
from training.imitation.algorithms.layers import two_hidden_layers
from training.imitation.algorithms.rollout import RolloutSteps, roll_out
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import Traffic
from training.imitation.traffic.scene_pool import ScenePool, draw_pool

Log = dict[str, float]
POLICY_BETAS, CRITIC_BETAS = (0.9, 0.99), (0.5, 0.9)
"""Decay rates of Adam's two moments, for policy and critic."""
MAX_GRADIENT_NORM = 1.0
"""Norm to which the gradient of the policy is clipped."""
_TRAINED_PARTS = ("policy", "critic", "value", "policy_optimiser", "critic_optimiser", "value_optimiser")
"""Attributes that have weights, or moments of an optimiser."""


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
        self.value = make_seeded(_make_value_network, self.generator).to(self.device)
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
        share = min(self.update / max(self.config.anneal * self.config.updates, 1.0), 1.0)
        return round(ends[0] + (ends[1] - ends[0]) * share)

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
        config = self.config
        return draw_pool(
            self.recording,
            self.among,
            config.scenes,
            self.linear_schedule(config.drivers),
            self.linear_schedule(config.horizon),
            config.colour,
            self.generator,
        )

    def learn_critic(self, steps: RolloutSteps) -> float:
        """Train the critic on this rollout and the ones before, and return its loss."""
        config = self.config
        self.rollouts.append(critic_inputs(self.policy, steps.features.detach(), steps.action.detach()))
        return train_critic(
            self.critic,
            self.critic_optimiser,
            self.recorded,
            self.rollouts,
            config.critic_steps,
            config.critic_batch,
            config.gradient_penalty,
            self.generator,
        )

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
            # attributes by name
            **{name: getattr(self, name).state_dict() for name in _TRAINED_PARTS},
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


def _make_value_network() -> nn.Sequential:
    """Return a network that estimates future rewards, for GAIL."""
    return two_hidden_layers(1, nn.Tanh)


Update = Callable[[Learner], Log]


def run_updates(learner: Learner, update: Update) -> Iterator[Log]:
    """Make the remaining updates, one by one.

    Args:
        learner: The training; it may have been resumed.
        update: One round: drive, train the critic, change the policy.

    Yields:
        Figures of each update.
    """
    if learner.update == 0:
        learner.warm_up()
    while learner.update < learner.config.updates:
        learner.set_rates()
        log = update(learner)
        learner.update += 1
        yield log
