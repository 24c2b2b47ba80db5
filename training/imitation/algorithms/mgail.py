"""MGAIL: the policy follows the gradient of its costs through the simulator.

Baram et al. learn a forward model, because their simulator has no gradient. Ours has one, so no model is needed and
nothing is approximated; their way is kept for comparison (`Config.learned_model`, see `forward_model`).

References:
    Baram, Anschel, Caspi and Mannor, "End-to-end differentiable adversarial imitation learning", ICML 2017.
"""

import torch

from training.imitation.algorithms.critic import critic_inputs, policy_cost
from training.imitation.algorithms.learner import Learner, Log


def update_mgail(learner: Learner) -> Log:
    """Drive with gradients, move the policy down them, train the critic."""
    config = learner.config
    steps = learner.drive(config.credit)
    likeness = policy_cost(learner.critic, critic_inputs(learner.policy, steps.features, steps.action)).mean()
    collision, edge, brake = steps.collision.mean(), steps.edge.mean(), steps.brake.mean()
    clone = learner.clone_loss()
    loss = (
        config.critic_weight * likeness
        + config.collision_weight * collision
        + config.edge_weight * edge
        + config.brake_weight * brake
        + config.headway_weight * steps.headway.mean()
        + config.lane_weight * steps.lane.mean()
        + config.speed_weight * steps.speed.mean()
        + config.geometric_schedule(config.clone_weight, learner.update) * clone
    )
    learner.policy_optimiser.zero_grad()
    torch.autograd.backward(loss)
    norm = torch.nn.utils.clip_grad_norm_(learner.policy.parameters(), 1.0)
    learner.policy_optimiser.step()
    critic, model = learner.learn_critic(steps), learner.learn_model(steps)
    return {
        "loss": float(loss.detach()),
        "likeness": float(likeness.detach()),
        "collision": float(collision.detach()),
        "edge": float(edge.detach()),
        "brake": float(brake.detach()),
        "headway": float(steps.headway.detach().mean()),
        "lane": float(steps.lane.detach().mean()),
        "speed": float(steps.speed.detach().mean()),
        "clone": float(clone.detach()),
        "gradient_norm": float(norm),
        "critic": critic,
        **({"model": model} if config.learned_model else {}),
    }
