"""GAIL and MGAIL: behaviour cloning, from which both start, the critic, their updates, the state of a training.

The critic tells recorded driving from a policy's, by the features and the action of one moment. MGAIL follows the
gradient of its costs through the simulator, which needs no forward model. GAIL follows rewards, minus the same costs
(reward augmentation, Bhattacharyya et al. 2019), by proximal policy optimisation with parameters that all vehicles
share; the gradient of the likelihood of recorded actions is added.

References:
    Baram, Anschel, Caspi and Mannor, "End-to-end differentiable adversarial imitation learning", ICML 2017. Ho and
    Ermon, "Generative adversarial imitation learning", NeurIPS 2016. Bhattacharyya et al., "Multi-agent imitation
    learning for driving simulation", 2018 (parameter sharing, curriculum). Schulman et al., "Proximal policy
    optimization algorithms", 2017; "High-dimensional continuous control using generalized advantage estimation", 2016.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from agents.learned.networks import ACTION_SIZE, FEATURE_SIZE, AutoregressiveNoise, Policy, Scaling
from training.checkpoints import read_checkpoint, write_checkpoint
from training.imitation.config import Config
from training.imitation.traffic import (
    Pairs,
    Penalties,
    Recording,
    RolloutSteps,
    ScenePool,
    Traffic,
    draw_pool,
    normalise_action,
    roll_out,
    total_cost,
)

Log = dict[str, float]
POLICY_BETAS, CRITIC_BETAS = (0.9, 0.99), (0.5, 0.9)
"""Decay rates of Adam's two moments, for policy and critic."""
CRITIC_RATE, VALUE_RATE = 4e-4, 1e-3
"""Learning rates of critic and value."""
CRITIC_STEPS, MEMORY, GRADIENT_PENALTY = 3, 8, 0.5
"""Updates of the critic in each update of the policy, rollouts that it learns from, weight of its gradient penalty."""
MOST = 60
"""Vehicles of a scene that are driven at most."""
CREDIT = 0.97
"""Of MGAIL: share of the gradient of the state that is passed on to the tick before."""
DISCOUNT, GAE_LAMBDA, CLIP, PPO_EPOCHS = 0.97, 0.95, 0.2, 4
"""Of proximal policy optimisation: discount of rewards, lambda of generalised advantage estimation, clipping range of
the probability ratio, epochs of an update."""
MAX_GRADIENT_NORM = 1.0
"""Norm to which the gradient of the policy is clipped."""
HIDDEN_UNITS, LEAK = 128, 0.2
"""Units of each hidden layer of critic and value, and the slope of the critic's activations below 0."""
_TRAINED_PARTS = ("policy", "critic", "value", "policy_optimiser", "critic_optimiser", "value_optimiser")
"""Attributes that have weights, or moments of an optimiser."""


Module = TypeVar("Module")


def log_likelihood(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Return the log density of normalised actions under independent Gaussians, (..., 2) -> (...,)."""
    z = (action - mean) * torch.exp(-log_std)
    return -(0.5 * z.square() + log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1)


def scaling_of(pairs: Pairs) -> Scaling:
    """Return means and spreads of recorded features and actions; the spread of a constant is set to 1."""
    if len(pairs.features) < 2:
        raise ValueError(f"Expected two or more recorded pairs, got {len(pairs.features)}; are there any followers?")
    std = pairs.features.std(dim=0)
    std = torch.where(std > 1e-6, std, torch.ones_like(std))
    return Scaling(pairs.features.mean(dim=0), std, pairs.action.mean(dim=0), pairs.action.std(dim=0).clamp(min=1e-6))


def make_seeded(make: Callable[[], Module], generator: torch.Generator) -> Module:
    """Return a network whose initial weights are drawn from a generator; PyTorch draws them from the global one."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        return make()


def clone_policy(pairs: Pairs, config: Config, generator: torch.Generator) -> Policy:
    """Return a new policy that maximises the likelihood of recorded actions; further epochs overfit."""
    policy = make_seeded(lambda: Policy(scaling_of(pairs)), generator).to(pairs.features.device)
    optimiser = torch.optim.Adam(policy.parameters(), lr=config.clone_rate, weight_decay=config.weight_decay)
    action = normalise_action(policy, pairs.action)
    for _ in range(config.epochs):
        for rows in torch.split(torch.randperm(len(action), generator=generator), config.batch):
            mean, log_std = policy(pairs.features[rows])
            descend(optimiser, -log_likelihood(mean, log_std, action[rows]).mean())
    return policy


def descend(optimiser: torch.optim.Optimizer, loss: Tensor, clipped: nn.Module | None = None) -> float:
    """Make one step down a loss; return the norm of the gradient of a network that is clipped, before it is."""
    optimiser.zero_grad()
    torch.autograd.backward(loss)
    norm = 0.0 if clipped is None else float(nn.utils.clip_grad_norm_(clipped.parameters(), MAX_GRADIENT_NORM))
    optimiser.step()
    return norm


def make_network(activation: Callable[[], nn.Module]) -> nn.Sequential:
    """Return a network of 53-128-128-1 units on pairs of features and actions (n, 53), whose output is (n,).

    A critic's is large where driving looks recorded.
    """
    sizes = (FEATURE_SIZE + ACTION_SIZE, HIDDEN_UNITS, HIDDEN_UNITS)
    hidden = [layer for pair in pairwise(sizes) for layer in (nn.Linear(*pair), activation())]
    return nn.Sequential(*hidden, nn.Linear(HIDDEN_UNITS, 1), nn.Flatten(0))


def make_critic() -> nn.Sequential:
    """Return a new critic, with LeakyReLU."""
    return make_network(lambda: nn.LeakyReLU(LEAK))


def critic_inputs(policy: Policy, features: Tensor, action: Tensor) -> Tensor:
    """Return the critic's input: normalised features (n, 51) beside normalised actions (n, 2)."""
    return torch.cat((policy.normalise(features), action), dim=1)


def policy_cost(critic: nn.Module, pairs: Tensor) -> Tensor:
    """Return -log of the probability that a pair is recorded, softplus(-logit), shape (n,).

    GAIL's paper minimises log(1 - D) of the probability D of the policy; this keeps a gradient where it is recognised.
    """
    return nn.functional.softplus(-critic(pairs))


def critic_loss(
    critic: nn.Module, recorded: Tensor, made: Tensor, penalty: float, generator: torch.Generator
) -> Tensor:
    """Return the logistic loss with a penalty on the mean squared gradient between recorded and made pairs (n, 53)."""
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
    critic: nn.Module
    generator: torch.Generator
    update: int = 0
    simulated: int = 0
    """Number of vehicle-steps so far."""

    def __post_init__(self) -> None:
        """Make optimisers, pools and the critic's memory; numbers are drawn on the CPU, the same for every device."""
        config, self.device = self.config, self.recording.x.device
        self.policy_optimiser = torch.optim.Adam(self.policy.parameters(), config.policy_rate, betas=POLICY_BETAS)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), CRITIC_RATE, betas=CRITIC_BETAS)
        self.value = make_seeded(lambda: make_network(nn.Tanh), self.generator).to(self.device)
        self.value_optimiser = torch.optim.Adam(self.value.parameters(), VALUE_RATE)
        self.pools: list[ScenePool] = []
        self.rollouts: deque[Tensor] = deque(maxlen=MEMORY)
        self.clone_pairs = self.pairs.features, normalise_action(self.policy, self.pairs.action)
        self.recorded = critic_inputs(self.policy, *self.clone_pairs)

    def linear_schedule(self, ends: tuple[int, int]) -> int:
        """Return the value at this update of a linear schedule of whole numbers."""
        return round(ends[0] + (ends[1] - ends[0]) * self.config.share(self.update))

    def drive(self, credit: float) -> RolloutSteps:
        """Drive the next pool for a horizon; a pool that is too old is restarted from the record."""
        config, horizon = self.config, self.linear_schedule(self.config.horizon)
        index, oldest = self.update % config.pools, self.linear_schedule(config.age)

        def start() -> ScenePool:
            return draw_pool(self.recording, self.among, config.scenes, MOST, horizon, config.colour, self.generator)

        while len(self.pools) < config.pools:
            self.pools.append(start())
        if self.pools[index].age >= oldest:
            self.pools[index] = start()
        steps, self.pools[index] = roll_out(
            self.recording, self.policy, self.pools[index], horizon, config.colour, credit, self.generator
        )
        self.simulated += len(steps.features)
        return steps

    def learn_critic(self, steps: RolloutSteps) -> float:
        """Make some steps on random pairs of the record, and of this and the last rollouts; return the last loss."""
        config, generator = self.config, self.generator
        self.rollouts.append(critic_inputs(self.policy, steps.features.detach(), steps.action.detach()))
        made = torch.cat(tuple(self.rollouts))
        loss = torch.zeros(())
        for _ in range(CRITIC_STEPS):
            rows = torch.randint(len(self.recorded), (config.critic_batch,), generator=generator)
            other = torch.randint(len(made), (config.critic_batch,), generator=generator)
            loss = critic_loss(self.critic, self.recorded[rows], made[other], GRADIENT_PENALTY, generator)
            descend(self.critic_optimiser, loss)
        return float(loss.detach())

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
        write_checkpoint(path, state)

    def load(self, path: Path) -> None:
        """Resume a saved training."""
        state = self.inherit(path)
        self.update, self.simulated = state["update"], state["simulated"]
        self.generator.set_state(state["generator"].cpu())
        self.rollouts.extend(state["rollouts"])
        self.pools = [ScenePool(Traffic(**pool["traffic"]), pool["noise"], pool["age"]) for pool in state["pools"]]

    def inherit(self, path: Path) -> dict[str, Any]:
        """Take over networks and optimisers of a saved training, not its progress; return the content of the file."""
        state = read_checkpoint(path, ("update", "pools", *_TRAINED_PARTS), self.device)
        for name in _TRAINED_PARTS:
            getattr(self, name).load_state_dict(state[name])  # likewise
        return state


def run_updates(learner: Learner) -> Iterator[Log]:
    """Make the remaining updates of a training, which may have been resumed, one by one; yield figures of each."""
    update = {"gail": update_gail, "mgail": update_mgail}[learner.config.method]
    config = learner.config
    rates = (learner.policy_optimiser, config.policy_rate), (learner.critic_optimiser, CRITIC_RATE)
    if learner.update == 0:
        for _ in range(config.warm_up):  # the critic learns before the policy moves
            with torch.no_grad():
                steps = learner.drive(1.0)
            learner.learn_critic(steps)
    while learner.update < config.updates:
        for optimiser, rate in rates:
            optimiser.param_groups[0]["lr"] = config.rate_factor(learner.update) * rate
        log = update(learner)
        learner.update += 1
        yield log


LEAST_SPREAD = 1e-6
"""Least standard deviation that advantages are divided by."""


def update_mgail(learner: Learner) -> Log:
    """Drive with gradients, move the policy down them, train the critic."""
    config = learner.config
    steps = learner.drive(CREDIT)
    likeness = policy_cost(learner.critic, critic_inputs(learner.policy, steps.features, steps.action)).mean()
    costs = Penalties(*(cost.mean() for cost in steps.costs))
    clone = learner.clone_loss()
    loss = total_cost(config, likeness, costs) + config.geometric_schedule(config.clone_weight, learner.update) * clone
    norm = descend(learner.policy_optimiser, loss, learner.policy)
    return {
        "loss": float(loss.detach()),
        "likeness": float(likeness.detach()),
        **{name: float(cost.detach()) for name, cost in costs._asdict().items()},
        "clone": float(clone.detach()),
        "gradient_norm": norm,
        "critic": learner.learn_critic(steps),
    }


def advantages(reward: Tensor, value: Tensor, discount: float, gae: float) -> Tensor:
    """Return generalised advantage estimates (T, n) of rewards (T, n) and values (T + 1, n), with lambda `gae`."""
    error = reward + discount * value[1:] - value[:-1]
    out = torch.empty_like(error)
    running = torch.zeros_like(error[0])
    for tick in reversed(range(len(error))):
        running = error[tick] + discount * gae * running
        out[tick] = running
    return out


def conditional_action(
    policy: Policy, features: Tensor, noise: Tensor, colour: AutoregressiveNoise
) -> tuple[Tensor, Tensor]:
    """Return mean and log standard deviation of actions, which are independent given the noise expected by now."""
    mean, log_std = policy(features)
    return mean + torch.exp(log_std) * noise, log_std + torch.log(noise.new_tensor(colour.scale))


def update_gail(learner: Learner) -> Log:
    """Drive, train the critic, then train policy and value by epochs over the rollout.

    The last tick of the rollout only gives the value of what comes after the one before it.
    """
    config, policy, value = learner.config, learner.policy, learner.value
    ticks = learner.linear_schedule(config.horizon)
    with torch.no_grad():
        steps = learner.drive(1.0)
    critic_error = learner.learn_critic(steps)
    with torch.no_grad():
        likeness = policy_cost(learner.critic, critic_inputs(policy, steps.features, steps.action))
        reward = -total_cost(config, likeness, steps.costs).view(ticks, -1)
        seen = torch.cat((policy.normalise(steps.features), steps.noise), dim=1)
        expected = value(seen).view(ticks, -1)
        gain = advantages(reward[:-1], expected, DISCOUNT, GAE_LAMBDA)
        target = (gain + expected[:-1]).flatten()
        kept = len(target)
        moments = conditional_action(policy, steps.features, steps.noise, config.colour)
        old = log_likelihood(*moments, steps.action)[:kept]
    gain = gain.flatten()
    gain = (gain - gain.mean()) / gain.std().clamp(min=LEAST_SPREAD)
    for _ in range(PPO_EPOCHS):
        for rows in torch.split(torch.randperm(kept, generator=learner.generator), config.ppo_batch):
            moments = conditional_action(policy, steps.features[rows], steps.noise[rows], config.colour)
            ratio = torch.exp(log_likelihood(*moments, steps.action[rows]) - old[rows])
            clone = config.geometric_schedule(config.clone_weight, learner.update) * learner.clone_loss()
            clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
            surrogate = torch.minimum(ratio * gain[rows], clipped * gain[rows]).mean()
            descend(learner.policy_optimiser, clone - surrogate, policy)
            error = (value(seen[rows]) - target[rows]).square().mean()
            descend(learner.value_optimiser, error)
    return {
        "reward": float(reward.mean()),
        **{name: float(getattr(steps.costs, name).mean()) for name in ("collision", "edge", "brake")},
        "value_error": float(error.detach()),
        "critic": critic_error,
    }
