"""What GAIL and MGAIL minimise, redone by hand."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from agents.learned.coloured_noise import AutoregressiveNoise
from agents.learned.networks import Policy, Scaling
from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.algorithms import mgail
from training.imitation.algorithms.actions import denormalise_action, log_likelihood, normalise_action
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.critic import Critic, critic_inputs, critic_loss, policy_cost
from training.imitation.algorithms.forward_model import ForwardModel, train_model
from training.imitation.algorithms.gail import advantages, clipped_surrogate, conditional_action, rewards, value_inputs
from training.imitation.algorithms.learner import run_updates
from training.imitation.fit import make_learner, prepare_data, train_learner

SMALL = Config(
    updates=12,
    epochs=1,
    batch=64,
    pools=1,
    scenes=2,
    horizon=(6, 6),
    age=(6, 6),
    critic_batch=32,
    warm_up=0,
    ppo_batch=80,
)


@pytest.fixture(scope="module")
def data():
    return prepare_data(scenes())


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def plain_policy():
    scaling = Scaling(torch.zeros(51), torch.ones(51), torch.tensor([0.5, 0.0]), torch.tensor([2.0, 0.1]))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Policy(scaling)


def test_advantages_by_hand():
    """Two ticks, discount 0.5, lambda 0.5: delta_1 = 2 + 0.5 * 4 - 2 = 2, delta_0 = 1 + 0.5 * 2 - 1 = 1."""
    reward, value = torch.tensor([[1.0], [2.0]]), torch.tensor([[1.0], [2.0], [4.0]])
    assert advantages(reward, value, 0.5, 0.5).flatten().tolist() == [1.5, 2.0]


def test_advantages_without_decay_are_returns_less_values():
    reward, value = torch.randn(6, 3, generator=generator()), torch.randn(7, 3, generator=generator(1))
    left = torch.stack([reward[t:].sum(dim=0) + value[-1] - value[t] for t in range(6)])
    torch.testing.assert_close(advantages(reward, value, 1.0, 1.0), left)


def test_the_clipped_surrogate():
    ratio = torch.tensor([1.5, 0.5, 1.5, 0.5, 1.1])
    advantage = torch.tensor([2.0, 2.0, -2.0, -2.0, 1.0])
    # a gain is not followed beyond 1.2, a loss is counted in full
    assert clipped_surrogate(ratio, advantage, 0.2).tolist() == pytest.approx([2.4, 1.0, -3.0, -1.6, 1.1])


def test_coloured_actions_have_the_joint_density_that_their_conditionals_multiply_to():
    """log p(a_1, .., a_T) of a stationary Gaussian process against the sum of conditionals and of the first two."""
    colour, ticks = Config().colour, 6
    policy = plain_policy().double()
    features = torch.randn(ticks, 51, generator=generator(2)).double()
    mean, log_std = policy(features)
    memory = colour.begin(torch.randn(1, 2, 2, generator=generator(3)).double())
    start, total, noises = memory.clone(), 0.0, []
    for t in range(ticks):
        expected = colour.predict_mean(memory)
        noise, memory = colour.step(memory, torch.randn(1, 2, generator=generator(4 + t)).double())
        action = mean[t : t + 1] + torch.exp(log_std[t : t + 1]) * noise
        law = conditional_action(policy, features[t : t + 1], expected, colour)
        total += float(log_likelihood(*law, action).detach())
        noises.append(noise[0])
    for k in range(2):  # acceleration, yaw rate
        correlation = autocorrelation(colour, k, ticks + 2)
        process = np.array([start[0, k, 1].item(), start[0, k, 0].item(), *(float(noise[k]) for noise in noises)])
        joint = gaussian_log_density(process, correlation) - gaussian_log_density(process[:2], correlation)
        total -= joint - float(log_std[:, k].detach().sum())
    assert total == pytest.approx(0.0, abs=1e-9)


def autocorrelation(colour, k, n):
    a, b = colour.first[k], colour.second[k]
    rho = [1.0, a / (1 - b)]
    for _ in range(n):
        rho.append(a * rho[-1] + b * rho[-2])
    return np.array(rho)


def gaussian_log_density(x, correlation):
    lags = np.abs(np.subtract.outer(np.arange(len(x)), np.arange(len(x))))
    matrix = correlation[lags]
    _, log_det = np.linalg.slogdet(matrix)
    return -0.5 * (x @ np.linalg.solve(matrix, x) + log_det + len(x) * math.log(2 * math.pi))


def test_white_noise_leaves_the_policy_as_it_is():
    policy, features = plain_policy(), torch.randn(4, 51, generator=generator())
    mean, log_std = conditional_action(policy, features, torch.zeros(4, 2), AutoregressiveNoise())
    torch.testing.assert_close((mean, log_std), policy(features))


def test_likelihood_is_that_of_torch():
    mean, log_std, action = (torch.randn(5, 2, generator=generator(k)) for k in range(3))
    expected = torch.distributions.Normal(mean, log_std.exp()).log_prob(action).sum(dim=1)
    torch.testing.assert_close(log_likelihood(mean, log_std, action), expected)


def test_actions_in_physical_units_and_back():
    policy, action = plain_policy(), torch.tensor([[0.3, -1.0]])
    assert denormalise_action(policy, action)[0].tolist() == pytest.approx([1.1, -0.1])
    torch.testing.assert_close(normalise_action(policy, denormalise_action(policy, action)), action)


def test_the_critic_s_loss_by_hand():
    """A linear critic w.x: the penalty is |w|^2 wherever it is taken, and the rest is the logistic loss."""
    critic = Critic()
    w = torch.randn(53, generator=generator()) * 0.1
    critic.layers = torch.nn.Sequential(torch.nn.Linear(53, 1, bias=False))
    with torch.no_grad():
        critic.layers[0].weight.copy_(w)
    recorded, made = torch.randn(7, 53, generator=generator(1)), torch.randn(7, 53, generator=generator(2))
    loss = critic_loss(critic, recorded, made, 0.5, generator())
    expected = np.log1p(np.exp(-(recorded @ w).numpy())).mean() + np.log1p(np.exp((made @ w).numpy())).mean()
    assert float(loss.detach()) == pytest.approx(expected + 0.5 * float(w @ w), rel=1e-5)


def test_the_gradient_penalty_of_a_deep_critic_by_finite_differences():
    torch.manual_seed(0)
    critic = Critic().double()
    recorded, made = (torch.randn(4, 53, generator=generator(k)).double() for k in range(2))
    penalty = critic_loss(critic, recorded, made, 1.0, generator(5)) - critic_loss(
        critic, recorded, made, 0.0, generator(5)
    )
    share = torch.rand(4, 1, generator=generator(5))
    between = share * recorded + (1 - share) * made
    eps, slopes = 1e-6, torch.zeros(4, 53).double()
    with torch.no_grad():
        for j in range(53):
            step = torch.zeros(53).double()
            step[j] = eps
            slopes[:, j] = (critic(between + step) - critic(between - step)) / (2 * eps)
    assert float(penalty.detach()) == pytest.approx(float(slopes.square().sum(dim=1).mean()), rel=1e-6)


def test_the_critic_s_cost_falls_where_driving_looks_recorded():
    critic = Critic()
    pairs = torch.randn(50, 53, generator=generator())
    logit = critic(pairs)
    cost = policy_cost(critic, pairs)
    torch.testing.assert_close(cost, -torch.log(torch.sigmoid(logit)))
    assert (cost.argsort(descending=True) == logit.argsort()).all()


def test_rewards_are_the_costs_of_mgail_with_another_sign(data):
    weights = {"critic_weight": 3.0, "collision_weight": 8.0, "edge_weight": 4.0, "brake_weight": 2.0}
    learner = make_learner(data, dataclasses.replace(SMALL, **weights))
    with torch.no_grad():
        steps = learner.drive(1.0)
        likeness = policy_cost(learner.critic, critic_inputs(learner.policy, steps.features, steps.action))
        reward = rewards(learner, steps)
    torch.testing.assert_close(reward, -(3 * likeness + 8 * steps.collision + 4 * steps.edge + 2 * steps.brake))
    assert value_inputs(learner.policy, steps).shape == (len(reward), 53)


def test_mgail_lowers_its_loss(data):
    """Twelve updates from a poor start: less braking."""
    config = dataclasses.replace(
        SMALL, policy_rate=1e-2, clone_weight=(1e-9, 1e-9), critic_weight=0.0, collision_weight=0.0, edge_weight=0.0
    )
    learner = make_learner(data, config)
    with torch.no_grad():
        learner.policy.head.bias[0] = -10.0  # brakes at about 4 m/s^2
    losses = [entry["brake"] for entry in run_updates(learner, mgail.update_mgail)]
    assert losses[-1] < 0.7 * losses[0]


def test_gail_brakes_less_when_braking_costs(data):
    config = dataclasses.replace(
        SMALL,
        method="gail",
        updates=25,
        scenes=8,
        colour=AutoregressiveNoise(),
        policy_rate=3e-3,
        clone_weight=(1e-9, 1e-9),
        critic_weight=0.0,
    )
    learner = make_learner(data, config)
    with torch.no_grad():
        learner.policy.head.bias[0], learner.policy.head.bias[2] = -6.0, 1.0
        before = float(learner.drive(1.0).brake.mean())
    train_learner(learner)
    with torch.no_grad():
        after = float(learner.drive(1.0).brake.mean())
    assert after < 0.7 * before


def test_the_forward_model_learns_and_leaves_values_alone(data):
    learner = make_learner(data, dataclasses.replace(SMALL, learned_model=True))
    with torch.no_grad():
        steps = learner.drive(1.0)
    errors = [learner.learn_model(steps) for _ in range(30)]
    assert errors[-1] < 0.5 * errors[0]
    now = torch.randn(2, 3, 51, generator=generator())
    action = torch.zeros(2, 3, 2, requires_grad=True)
    found = learner.model.substitute_gradient(learner.policy, now, action, now + 1, 0.5)
    torch.testing.assert_close(found, now + 1)
    (slope,) = torch.autograd.grad(found.sum(), action)
    whole = learner.model.substitute_gradient(learner.policy, now, action, now + 1, 1.0)
    torch.testing.assert_close(slope * 2, torch.autograd.grad(whole.sum(), action)[0])


def test_a_linear_world_is_learned_with_its_jacobian():
    """s' = s + B a: the model finds B."""
    policy, draw = plain_policy(), generator()
    b = torch.randn(51, 2, generator=draw) * 0.3
    model, seen, done = ForwardModel(), [torch.randn(400, 51, generator=draw)], torch.randn(6, 400, 2, generator=draw)
    for action in done[:-1]:
        seen.append(seen[-1] + action @ b.T)
    optimiser = torch.optim.Adam(model.parameters(), 3e-3)
    train_model(model, optimiser, policy, torch.stack(seen), done, 600, 256, draw)
    with torch.no_grad():
        columns = [
            model(policy, seen[0], done[0] + e) - model(policy, seen[0], done[0] - e) for e in 0.5 * torch.eye(2)
        ]
    slope = torch.stack([column.mean(dim=0) for column in columns], dim=1)
    assert float((slope - b).norm() / b.norm()) < 0.15


def test_through_a_learned_model_the_state_s_penalties_have_no_gradient(data):
    learner = make_learner(data, dataclasses.replace(SMALL, learned_model=True, scenes=4))
    steps = learner.drive(1.0)
    assert not steps.collision.requires_grad
    assert not steps.edge.requires_grad
    assert steps.brake.requires_grad
    assert steps.features.requires_grad
