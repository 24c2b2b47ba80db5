"""Fine-tuning of a driver: some hundred further updates of MGAIL, in recorded scenes and in stop-and-go traffic.

Recorded people never brake hard and hardly ever stop, so that a driver that learned from them alone brakes too little
behind a standing queue. Here each update also drives stop-and-go scenes (`training.imitation.traffic.stop_and_go`),
where penalties for nearness and the edge count, and what the IDM would do: critic and likelihood know recorded scenes
only. The critic is new, and the noise of the acceleration has less power at low frequencies (`NARROW_NOISE`).

References:
    Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
    learning", AISTATS 2011.
    Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022, for means of weights before and after.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from agents import LearnedDriver
from agents.learned.coloured_noise import AutoregressiveNoise
from agents.learned.networks import Policy
from agents.learned.rule_driver import RuleDriver
from training.imitation.algorithms.actions import normalise_action
from training.imitation.algorithms.behaviour_cloning import make_seeded
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.critic import Critic
from training.imitation.algorithms.learner import Learner, run_updates
from training.imitation.algorithms.mgail import update_mgail
from training.imitation.algorithms.rollout import roll_out
from training.imitation.fit import Data
from training.imitation.run_folder import driver_of
from training.imitation.traffic.recording import Recording, stack_scenes
from training.imitation.traffic.scene_pool import ScenePool, draw_pool
from training.imitation.traffic.stop_and_go import make_stop_and_go

NARROW_NOISE = AutoregressiveNoise.from_oscillators(frequency=(1.866, 1.57), damping=(0.35, 0.40))
"""As `HUMAN_NOISE`, with the same variances of acceleration and jerk; the acceleration oscillates longer, so that it
adds up to less: at frequency 0 its power is 0.41 times as great."""
DENSE_TICKS = 25
"""Number of ticks of a rollout."""
FINE_TUNING = Config(
    updates=150,
    epochs=0,
    anneal=0.6,
    policy_rate=1.5e-4,
    brake_weight=4.0,
    horizon=(DENSE_TICKS, DENSE_TICKS),
    age=(150, 150),
    clone_weight=(0.1, 0.1),
    colour=NARROW_NOISE,
)
"""Settings of the recorded part."""
NEAR_WEIGHT, RULE_WEIGHT = 0.1, 0.2
"""Weights of the penalties and of `rule_cost` in stop-and-go traffic."""
RULE_BOUNDS = (-5.0, 1.5)
"""Of the rule's acceleration [m/s^2]."""
DENSE_POOLS, DENSE_AT_ONCE = 4, 2
"""Number of pools of stop-and-go scenes that are driven in turn, and of scenes in a pool."""


@dataclass
class StopAndGo:
    """Stop-and-go traffic that is driven beside the recorded scenes; called, it returns its cost in this update."""

    recording: Recording
    rule_weight: float = RULE_WEIGHT
    age: int = FINE_TUNING.age[1]
    """Number of ticks after which a pool starts anew."""
    pools: dict[int, ScenePool] = field(default_factory=dict)

    @classmethod
    def draw(cls, scenes: int, seed: int, rule_weight: float = RULE_WEIGHT) -> StopAndGo:
        """Return traffic of some scenes; the seed decides which."""
        rng = np.random.default_rng(seed)
        return cls(stack_scenes([make_stop_and_go(rng) for _ in range(scenes)]), rule_weight)

    def __call__(self, learner: Learner) -> Tensor:
        """Drive the next pool and return the weighted sum of penalties and `rule_cost`."""
        config, number = learner.config, learner.update % DENSE_POOLS
        if number not in self.pools or self.pools[number].age >= self.age:
            self.pools[number] = self._new_pool(learner)
        steps, self.pools[number] = roll_out(
            self.recording,
            learner.policy,
            self.pools[number],
            DENSE_TICKS,
            config.colour,
            config.credit,
            learner.generator,
        )
        costs = steps.costs
        near = config.collision_weight * costs.collision.mean() + config.edge_weight * costs.edge.mean()
        return NEAR_WEIGHT * near + self.rule_weight * rule_cost(learner.policy, steps.features.detach())

    def _new_pool(self, learner: Learner) -> ScenePool:
        """Return scenes at their first tick, where alone those that are driven have their places."""
        every, longest = torch.arange(len(self.recording.x)), self.recording.x.shape[1]
        most, colour = max(learner.config.drivers), learner.config.colour
        return draw_pool(self.recording, every, DENSE_AT_ONCE, most, longest, colour, learner.generator)


def rule_cost(policy: Policy, features: Tensor) -> Tensor:
    """Return the mean squared distance of mean accelerations from those of the IDM, in spreads of recorded ones.

    The driver is corrected where it comes itself, as by DAgger (Ross et al., 2011): what it does is driven, and what
    the rule would do is learned.

    Args:
        policy: The driver's network.
        features: Moments of stop-and-go traffic, shape (n, 51).
    """
    mean, _ = policy(features)
    action, _ = RuleDriver().act(features[None])
    wanted = torch.stack((action[0, :, 0].clamp(*RULE_BOUNDS), action[0, :, 1]), dim=-1)
    distance: Tensor = (mean[:, 0] - normalise_action(policy, wanted)[:, 0]).square().mean()
    return distance


def make_fine_tuning(data: Data, driver: LearnedDriver, config: Config = FINE_TUNING) -> Learner:
    """Return a training that goes on from a driver, with a new critic.

    Args:
        data: Recorded traffic.
        driver: The driver, which is left as it is.
        config: Settings.
    """
    generator = torch.Generator().manual_seed(config.seed)
    policy = copy.deepcopy(driver.policy).requires_grad_(True).train()
    critic = make_seeded(Critic, generator)
    return Learner(config, data.recording, torch.unique(data.pairs.scene), data.pairs, policy, critic, generator)


def fine_tune(learner: Learner, beside: Callable[[Learner], Tensor]) -> LearnedDriver:
    """Make all updates and return the driver after the last.

    Args:
        learner: As `make_fine_tuning` returns it.
        beside: Cost of the traffic that is driven beside the recorded scenes, such as `StopAndGo`.
    """
    for _ in run_updates(learner, partial(update_mgail, beside=beside)):
        pass
    return driver_of(learner.policy, learner.config)


def mix_drivers(before: LearnedDriver, after: LearnedDriver, share: float) -> LearnedDriver:
    """Return a driver with weights between those of two, and the noise of the second.

    Args:
        before: The first.
        after: The second, of the same architecture.
        share: Of the second, 0 to 1.

    Raises:
        ValueError: The share is outside of 0 to 1.
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"Expected a share from 0 to 1, got {share}.")
    first, second = before.policy.state_dict(), after.policy.state_dict()
    policy = copy.deepcopy(after.policy)
    policy.load_state_dict({name: torch.lerp(first[name], value, share) for name, value in second.items()})
    return replace(after, policy=policy, weights=None)
