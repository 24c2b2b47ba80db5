"""MGAIL: the policy follows the gradient of its costs through the simulator.

Baram et al. learn a forward model, because their simulator has no gradient. Ours has one, so no model is needed and
nothing is approximated.

References:
    Baram, Anschel, Caspi and Mannor, "End-to-end differentiable adversarial imitation learning", ICML 2017.
"""

import torch

from training.imitation.algorithms.critic import critic_inputs, policy_cost
from training.imitation.algorithms.learner import MAX_GRADIENT_NORM, Learner, Log
from training.imitation.algorithms.penalties import Penalties, total_cost


def update_mgail(learner: Learner) -> Log:
    """Drive with gradients, move the policy down them, train the critic."""
    config = learner.config
    steps = learner.drive(config.credit)
    likeness = policy_cost(learner.critic, critic_inputs(learner.policy, steps.features, steps.action)).mean()
    costs = Penalties(*(cost.mean() for cost in steps.costs))
    clone = learner.clone_loss()
    loss = total_cost(config, likeness, costs) + config.geometric_schedule(config.clone_weight, learner.update) * clone
    learner.policy_optimiser.zero_grad()
    torch.autograd.backward(loss)
    norm = torch.nn.utils.clip_grad_norm_(learner.policy.parameters(), MAX_GRADIENT_NORM)
    learner.policy_optimiser.step()
    return {
        "loss": float(loss.detach()),
        "likeness": float(likeness.detach()),
        **{name: float(cost.detach()) for name, cost in costs._asdict().items()},
        "clone": float(clone.detach()),
        "gradient_norm": float(norm),
        "critic": learner.learn_critic(steps),
    }
