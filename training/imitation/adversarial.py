"""Updates of GAIL and MGAIL.

MGAIL follows the gradient of its costs through the simulator. Baram et al. learn a forward model, because their
simulator has no gradient; ours has one, so nothing is approximated.

GAIL follows rewards by proximal policy optimisation; all vehicles share its parameters. The reward of a moment is minus
the costs that MGAIL descends: the critic's, and the penalties (reward augmentation, Bhattacharyya et al. 2019). As
there, the gradient of the likelihood of recorded actions is added.

References:
    Baram, Anschel, Caspi and Mannor, "End-to-end differentiable adversarial imitation learning", ICML 2017. Ho and
    Ermon, "Generative adversarial imitation learning", NeurIPS 2016. Bhattacharyya et al., "Multi-agent imitation
    learning for driving simulation", 2018 (parameter sharing, curriculum). Schulman et al., "Proximal policy
    optimization algorithms", 2017; "High-dimensional continuous control using generalized advantage estimation", 2016.
"""

import torch
from torch import Tensor

from agents.learned.networks import AutoregressiveNoise, Policy
from training.imitation.learner import Learner, Log, critic_inputs, descend, log_likelihood, policy_cost
from training.imitation.rollout import Penalties, RolloutSteps, total_cost

LEAST_SPREAD = 1e-6
"""Least standard deviation that advantages are divided by."""


def update_mgail(learner: Learner) -> Log:
    """Drive with gradients, move the policy down them, train the critic."""
    config = learner.config
    steps = learner.drive(config.credit)
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
    """Return generalised advantage estimates (T, n) of rollouts that continue beyond their last moment.

    Of rewards (T, n) and values (T + 1, n), of which the last are those of the moment after; discount per tick, and
    lambda of the estimates.
    """
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
    """Return mean and log standard deviation of actions, given the expected noise.

    Coloured noise makes actions depend on each other; given the noise before, they are independent Gaussians again.
    """
    mean, log_std = policy(features)
    return mean + torch.exp(log_std) * noise, log_std + torch.log(noise.new_tensor(colour.scale))


def value_inputs(policy: Policy, steps: RolloutSteps) -> Tensor:
    """Return the input of the value network: normalised features and the expected noise, shape (n, 53)."""
    return torch.cat((policy.normalise(steps.features), steps.noise), dim=1)


def rewards(learner: Learner, steps: RolloutSteps) -> Tensor:
    """Return minus the costs of each moment, shape (n,)."""
    likeness = policy_cost(learner.critic, critic_inputs(learner.policy, steps.features, steps.action))
    return -total_cost(learner.config, likeness, steps.costs)


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
        reward = rewards(learner, steps).view(ticks, -1)
        seen = value_inputs(policy, steps)
        expected = value(seen).view(ticks, -1)
        gain = advantages(reward[:-1], expected, config.discount, config.gae)
        target = (gain + expected[:-1]).flatten()
        kept = len(target)
        moments = conditional_action(policy, steps.features, steps.noise, config.colour)
        old = log_likelihood(*moments, steps.action)[:kept]
    gain = gain.flatten()
    gain = (gain - gain.mean()) / gain.std().clamp(min=LEAST_SPREAD)
    for _ in range(config.ppo_epochs):
        for rows in torch.split(torch.randperm(kept, generator=learner.generator), config.ppo_batch):
            moments = conditional_action(policy, steps.features[rows], steps.noise[rows], config.colour)
            ratio = torch.exp(log_likelihood(*moments, steps.action[rows]) - old[rows])
            clone = config.geometric_schedule(config.clone_weight, learner.update) * learner.clone_loss()
            clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
            surrogate = torch.minimum(ratio * gain[rows], clipped * gain[rows]).mean()
            descend(learner.policy_optimiser, clone - surrogate, policy)
            error = (value(seen[rows])[:, 0] - target[rows]).square().mean()
            descend(learner.value_optimiser, error)
    return {
        "reward": float(reward.mean()),
        **{name: float(getattr(steps.costs, name).mean()) for name in ("collision", "edge", "brake")},
        "value_error": float(error.detach()),
        "critic": critic_error,
    }
