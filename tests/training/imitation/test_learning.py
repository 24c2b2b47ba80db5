"""Cloning, GAIL and MGAIL and their parts: settings, penalties, gradients, critic; trainings that learn and resume."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from agents.learned.networks import Policy
from tests.training.imitation.synthetic_scenes import SMALL, at_start, generator, plain_policy, scenes, tiny
from training.imitation.config import Config
from training.imitation.learner import (
    advantages,
    clone_policy,
    conditional_action,
    critic_loss,
    log_likelihood,
    run_updates,
    scaling_of,
)
from training.imitation.traffic import (
    Pairs,
    Recording,
    ScenePool,
    Traffic,
    collect_pairs,
    compute_penalties,
    normalise_action,
    roll_out,
    stack_scenes,
)
from training.imitation.train import make_learner, train_learner


def test_a_linear_driver_is_cloned_with_its_noise():
    """Actions are two of the features, and Gaussian noise."""
    features = torch.randn(1500, 51, generator=generator(1))
    action = features[:, :2] + 0.1 * torch.randn(1500, 2, generator=generator(2))
    pairs = Pairs(features, action, torch.zeros(1500, dtype=torch.long))
    policy = clone_policy(pairs, tiny(epochs=20, batch=128, clone_rate=3e-3, weight_decay=0.0), generator())
    with torch.no_grad():
        mean, log_std = policy(pairs.features)
    off = mean - normalise_action(policy, pairs.action)
    # of the variance of actions, 1 + 0.1^2, 0.01 cannot be explained; the network leaves at most four times that
    assert off.square().mean() < 0.04
    # and knows how large its errors are: a Gaussian's likelihood is greatest at the root mean square
    torch.testing.assert_close(log_std.exp().mean(dim=0), off.square().mean(dim=0).sqrt(), rtol=0.3, atol=0.0)


def test_settings_are_checked():
    wrong = {"method": "sac", "updates": 0, "epochs": -1, "pools": 0, "horizon": (15, 0), "clone_weight": (0.1, 0.0)}
    wrong |= {"policy_rate": float("nan"), "edge_weight": -1.0}
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=f"Expected {name}"):
            Config(**{name: value})


def moment(x, y, speed, edges=(0.0, 3.6, 7.2)):
    """Traffic of one scene whose vehicles are 4.5 m long and 2 m wide, and features with nothing in sight."""
    x, y, speed = (torch.tensor([values]) for values in (x, y, speed))
    there = torch.ones_like(x, dtype=torch.bool)
    sizes, edges, row = (0 * x + 4.5, 0 * x + 2.0), torch.tensor([edges]), torch.zeros(1, dtype=torch.long)
    vehicle = torch.arange(x.shape[1])[None]
    features = torch.zeros(1, x.shape[1], 51)
    features[..., 11:31] = 100.0
    return Traffic(x, y, 0 * x, speed, *sizes, edges, row, row, vehicle, there, there), features


def test_penalties_on_paper():
    traffic, features = moment([0.0, 6.0, 0.0], [1.8, 1.8, 5.4], [0.0, 0.0, 0.0])
    action = torch.tensor([[[-3.0, 0.0], [0.0, 0.0], [0.0, 0.0]]])
    cost = compute_penalties(traffic, features, action)
    # 1.5 m to the car ahead, which overlaps across by 2 m: (1 - 1.5 / 3) (1 + 2 / 0.8); 1.6 m beside the third: none
    assert cost.collision[0].tolist() == pytest.approx([0.5 * 3.5, 0.5 * 3.5, 0.0])
    assert cost.brake[0].tolist() == [1.0, 0.0, 0.0]
    assert (cost.edge == 0).all()
    off = compute_penalties(traffic._replace(y=traffic.y - 1.5), features, action)
    assert off.edge[0, 0] == pytest.approx(0.7)
    traffic, features = moment([1.0], [1.8], [1.0], (0.0, 3.6))  # closing in costs before contact
    features[..., 11 + 9], features[..., 31 + 9] = 22.25, -10.0  # 20 m of gap, 10 m/s: 2.5 m/s^2 are needed
    assert compute_penalties(traffic, features, torch.zeros(1, 1, 2)).collision == pytest.approx(0.1)


def test_the_gradient_of_a_rollout_is_that_of_finite_differences(recording):
    recording = Recording(*(field.double() if field.is_floating_point() else field for field in recording))
    policy = Policy(scaling_of(collect_pairs(stack_scenes(scenes())))).double()
    traffic = Traffic(*(f.double() if f.is_floating_point() else f for f in at_start(recording)))
    noise = torch.randn(3, traffic.drivers, 2, 2, generator=torch.Generator().manual_seed(3)).double()
    head = policy.head.weight

    def cost():
        generator = torch.Generator().manual_seed(0)
        steps, _ = roll_out(recording, policy, ScenePool(traffic, noise), 20, Config().colour, 1.0, generator)
        return (steps.features[:, 31:].square().mean() + steps.action.square().mean()) + steps.costs.collision.mean()

    (gradient,) = torch.autograd.grad(cost(), head)
    direction = torch.randn(head.shape, generator=torch.Generator().manual_seed(1)).double()
    eps = 1e-6
    with torch.no_grad():
        head += eps * direction
        above = cost()
        head -= 2 * eps * direction
        below = cost()
        head += eps * direction
    slope = float((above - below) / (2 * eps))
    assert float((gradient * direction).sum()) == pytest.approx(slope, rel=1e-6)


def test_the_critic_s_loss_by_hand():
    """A linear critic w.x: the penalty is |w|^2 wherever it is taken, and the rest is the logistic loss."""
    w = torch.randn(53, generator=generator()) * 0.1
    critic = torch.nn.Sequential(torch.nn.Linear(53, 1, bias=False), torch.nn.Flatten(0))
    with torch.no_grad():
        critic[0].weight.copy_(w)
    recorded, made = torch.randn(7, 53, generator=generator(1)), torch.randn(7, 53, generator=generator(2))
    loss = critic_loss(critic, recorded, made, 0.5, generator())
    expected = np.log1p(np.exp(-(recorded @ w).numpy())).mean() + np.log1p(np.exp((made @ w).numpy())).mean()
    assert float(loss.detach()) == pytest.approx(expected + 0.5 * float(w @ w), rel=1e-5)


def test_advantages_by_hand():
    """Two ticks, discount 0.5, lambda 0.5: delta_1 = 2 + 0.5 * 4 - 2 = 2, delta_0 = 1 + 0.5 * 2 - 1 = 1."""
    reward, value = torch.tensor([[1.0], [2.0]]), torch.tensor([[1.0], [2.0], [4.0]])
    assert advantages(reward, value, 0.5, 0.5).flatten().tolist() == [1.5, 2.0]


def gaussian_log_density(x, correlation):
    lags = np.abs(np.subtract.outer(np.arange(len(x)), np.arange(len(x))))
    matrix = correlation[lags]
    _, log_det = np.linalg.slogdet(matrix)
    return -0.5 * (x @ np.linalg.solve(matrix, x) + log_det + len(x) * math.log(2 * math.pi))


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
        moments = conditional_action(policy, features[t : t + 1], expected, colour)
        total += float(log_likelihood(*moments, action).detach())
        noises.append(noise[0])
    for k in range(2):  # acceleration, yaw rate
        a, b = colour.first[k], colour.second[k]
        rho = [1.0, a / (1 - b)]
        for _ in range(ticks + 2):
            rho.append(a * rho[-1] + b * rho[-2])
        correlation = np.array(rho)
        process = np.array([start[0, k, 1].item(), start[0, k, 0].item(), *(float(noise[k]) for noise in noises)])
        joint = gaussian_log_density(process, correlation) - gaussian_log_density(process[:2], correlation)
        total -= joint - float(log_std[:, k].detach().sum())
    assert total == pytest.approx(0.0, abs=1e-9)


def test_mgail_lowers_its_loss(data):
    """Twelve updates from a poor start: less braking."""
    config = dataclasses.replace(
        SMALL, policy_rate=1e-2, clone_weight=(1e-9, 1e-9), critic_weight=0.0, collision_weight=0.0, edge_weight=0.0
    )
    learner = make_learner(data, config)
    with torch.no_grad():
        learner.policy.head.bias[0] = -10.0  # brakes at about 4 m/s^2
    losses = [entry["brake"] for entry in run_updates(learner)]
    assert losses[-1] < 0.7 * losses[0]


def weights(policy):
    return torch.cat([value.flatten() for value in policy.state_dict().values()])


@pytest.mark.parametrize("method", ["gail", "mgail"])
def test_a_killed_training_resumes_to_the_same_weights(data, method, tmp_path):
    config = tiny(method=method)
    whole = train_learner(make_learner(data, config))
    stopped = make_learner(data, config)

    class Killed(Exception):
        pass

    save = stopped.save

    def save_and_die(path):
        save(path)
        raise Killed

    stopped.save = save_and_die
    with pytest.raises(Killed):
        train_learner(stopped, tmp_path, every=3)
    assert stopped.update == 3
    resumed = train_learner(make_learner(data, config), tmp_path, every=3)
    assert torch.equal(weights(resumed), weights(whole))
    assert not torch.equal(weights(make_learner(data, config).policy), weights(whole))
