"""Driven and replayed traffic: exact inversion of the record, who is driven, gradients, realism."""

import math

import numpy as np
import pytest
import torch

from agents.learned.networks import Policy
from tests.training.imitation.synthetic_scenes import scene, scenes
from training.imitation.algorithms.actions import denormalise_action
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.expert_pairs import collect_pairs, emphasise_lateral, scaling_of
from training.imitation.algorithms.penalties import compute_penalties
from training.imitation.algorithms.rollout import roll_out
from training.imitation.evaluation.behaviour import find_overlaps
from training.imitation.evaluation.driving_statistics import BINS
from training.imitation.evaluation.realism import jensen_shannon, measure
from training.imitation.traffic.recording import Recording, stack_scenes
from training.imitation.traffic.replayed_traffic import Traffic, perceive_traffic, start_replay, step_replay
from training.imitation.traffic.scene_pool import ScenePool


@pytest.fixture
def recording():
    return stack_scenes(scenes())


def at_start(recording, tick=0):
    rows = torch.arange(len(recording.x))
    return start_replay(recording, rows, torch.full_like(rows, tick))


def recorded(recording, traffic, name):
    return getattr(recording, name)[traffic.scene, traffic.tick].gather(1, traffic.vehicle)


def test_recorded_actions_reproduce_the_record(recording):
    traffic = at_start(recording)
    for _ in range(25):
        action = torch.stack([recorded(recording, traffic, name) for name in ("acceleration", "yaw_rate")], dim=-1)
        traffic = step_replay(recording, traffic, action)
    for name in ("x", "y", "heading", "speed"):
        torch.testing.assert_close(getattr(traffic, name), recorded(recording, traffic, name), atol=1e-4, rtol=0)


def test_the_first_of_each_lane_is_replayed_and_comes_after_the_driven(recording):
    traffic = at_start(recording)
    assert traffic.driven.sum(dim=1).tolist() == [6, 6, 6]
    assert traffic.driven[:, :6].all()
    assert (traffic.vehicle[:, 6:].sort(dim=1)[0] == torch.tensor([6, 7, 8])).all()


def test_replayed_vehicles_follow_the_record_and_then_keep_their_speed(recording):
    traffic = at_start(recording)
    still = torch.zeros(*traffic.x.shape, 2)
    for _ in range(40):
        traffic = step_replay(recording, traffic, still)
    last = (traffic.vehicle == 8).nonzero()  # recorded up to tick 29
    for b, i in last.tolist():
        end = recording.x[b, 29, 8] + 11 * 0.1 * recording.speed[b, 29, 8] * torch.cos(recording.heading[b, 29, 8])
        assert traffic.x[b, i] == pytest.approx(float(end), abs=1e-3)
    ahead = traffic.vehicle == 7
    torch.testing.assert_close(traffic.x[ahead], recording.x[:, 40, 7])


def test_driven_vehicles_stop_and_do_not_reverse(recording):
    traffic = at_start(recording)
    brake = torch.zeros(*traffic.x.shape, 2)
    brake[..., 0] = -8.0
    for _ in range(30):
        traffic = step_replay(recording, traffic, brake)
    assert (traffic.speed[traffic.driven] == 0).all()


def test_a_curriculum_drives_the_rearmost(recording):
    rows = torch.arange(3)
    traffic = start_replay(recording, rows, torch.zeros_like(rows), most=2)
    assert traffic.driven.sum(dim=1).tolist() == [2, 2, 2]
    assert traffic.x[traffic.driven].max() < 25


def test_pairs_hold_every_known_moment_of_followers(recording):
    pairs = collect_pairs(recording)
    # six followers for 59 ticks, and from tick 30 on one lane has lost its first car: its second is the first now
    assert len(pairs.features) == 3 * (6 * 59 - 29)
    assert scaling_of(pairs).feature_std.min() > 0
    assert pairs.action[:, 0].abs().max() <= 0.6 + 1e-6


def test_moments_of_fast_motion_across_count_several_times(recording):
    pairs = collect_pairs(recording)
    pairs = pairs._replace(features=pairs.features.clone())
    pairs.features[:, 1] = 0.0
    pairs.features[5, 1], pairs.features[5, 2] = -0.05, 10.0  # 0.5 m/s to the left
    pairs.features[9, 1], pairs.features[9, 2] = 0.05, 6.0  # 0.3 m/s
    more = emphasise_lateral(pairs, 3)
    assert len(more.features) == len(pairs.features) + 2
    for column, whole in zip(more, pairs, strict=True):
        torch.testing.assert_close(column[-2:], whole[[5, 5]])
    assert emphasise_lateral(pairs, 1) is pairs


def test_scenes_without_followers_are_refused():
    lonely = scene(vehicles=3)
    with pytest.raises(ValueError, match="followers"):
        scaling_of(collect_pairs(stack_scenes([lonely])))


def doubled(recording):
    return Recording(*(field.double() if field.is_floating_point() else field for field in recording))


def test_the_gradient_of_a_rollout_is_that_of_finite_differences(recording):
    recording = doubled(recording)
    policy = Policy(scaling_of(collect_pairs(stack_scenes(scenes())))).double()
    traffic = Traffic(*(f.double() if f.is_floating_point() else f for f in at_start(recording)))
    noise = torch.randn(3, traffic.drivers, 2, 2, generator=torch.Generator().manual_seed(3)).double()
    head = policy.head.weight

    def cost():
        generator = torch.Generator().manual_seed(0)
        steps, _ = roll_out(recording, policy, ScenePool(traffic, noise), 20, Config().colour, 1.0, generator)
        return (steps.features[:, 31:].square().mean() + steps.action.square().mean()) + steps.collision.mean()

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


def test_credit_decay_changes_gradients_only(recording):
    policy = Policy(scaling_of(collect_pairs(recording)))
    traffic = at_start(recording)
    noise = torch.zeros(3, traffic.drivers, 2, 2)

    def rolled(credit):
        steps, pool = roll_out(
            recording, policy, ScenePool(traffic, noise), 5, Config().colour, credit, torch.Generator().manual_seed(0)
        )
        (gradient,) = torch.autograd.grad(steps.features.sum(), policy.head.weight)
        return pool.traffic.x, gradient

    (x, full), (same, decayed) = rolled(1.0), rolled(0.5)
    torch.testing.assert_close(x, same, rtol=1e-6, atol=1e-4)
    assert decayed.norm() < full.norm()


def test_penalties_on_paper():
    x, y = torch.tensor([[0.0, 6.0, 0.0]]), torch.tensor([[1.8, 1.8, 5.4]])
    size = torch.full((1, 3), 4.5), torch.full((1, 3), 2.0)
    edges = torch.tensor([[0.0, 3.6, 7.2]])
    features = torch.zeros(1, 3, 51)
    features[..., 11:31] = 100.0
    action = torch.tensor([[[-3.0, 0.0], [0.0, 0.0], [0.0, 0.0]]])
    cost = compute_penalties(x, y, 0.0 * x, *size, edges, features, action, 3)
    # 1.5 m to the car ahead, which overlaps across by 2 m: (1 - 1.5 / 3) (1 + 2 / 0.8); 1.6 m beside the third: none
    assert cost.collision[0].tolist() == pytest.approx([0.5 * 3.5, 0.5 * 3.5, 0.0])
    assert cost.brake[0].tolist() == [1.0, 0.0, 0.0]
    assert (cost.edge == 0).all()
    off = compute_penalties(x, y - 1.5, 0.0 * x, *size, edges, features, action, 3)
    assert off.edge[0, 0] == pytest.approx(0.7)


def test_closing_in_costs_before_contact():
    features = torch.zeros(1, 1, 51)
    features[..., 11:31] = 100.0
    features[..., 11 + 9], features[..., 31 + 9] = 22.25, -10.0  # 20 m of gap, 10 m/s: 2.5 m/s^2 are needed
    one = torch.zeros(1, 1)
    edges = torch.tensor([[0.0, 3.6]])
    cost = compute_penalties(one, one + 1.8, one, one + 4.5, one + 2, edges, features, torch.zeros(1, 1, 2), 1)
    assert cost.collision == pytest.approx(0.1)


def test_manners_cost_on_paper():
    """Distance to whoever reaches into the own path, the middle of the lane, and the limit."""
    x, y = torch.tensor([[0.0, 20.5, 14.5]]), torch.tensor([[1.8, 1.8, 4.2]])
    speed = torch.tensor([[30.0, 24.0, 30.0]])
    size = torch.full((1, 3), 4.5), torch.full((1, 3), 2.0)
    features = torch.zeros(1, 3, 51)
    features[..., 11:31] = 100.0
    features[0, :, 0], features[0, :, 2] = torch.tensor([0.0, -0.2, 0.6]), speed[0]
    cost = compute_penalties(x, y, speed, *size, torch.tensor([[0.0, 3.6, 7.2]]), features, torch.zeros(1, 3, 2), 3)
    # 16 m to the lead, less 6 in which to slow down at 3 m/s^2, of 2 + 1.2 * 30 m. The third is as near to it,
    # but, 0.4 m beside its path, only half in it
    assert cost.headway[0].tolist() == pytest.approx([1 - 10 / 38, 0.0, 0.5 * (1 - (1.5 - 6) / 38)])
    assert cost.lane[0].tolist() == pytest.approx([0.0, 0.0, 0.3])
    assert cost.speed[0].tolist() == pytest.approx([0.1, 0.0, 0.1])


def test_overlap_of_boxes():
    traffic = at_start(stack_scenes([scene(vehicles=6)]))
    traffic = traffic._replace(x=traffic.x * 0, y=traffic.y * 0, heading=traffic.heading * 0)
    beside = traffic._replace(y=torch.tensor([[0.0, 1.8, 3.0, 5.4, 30.0, 60.0]]))
    assert find_overlaps(beside, 6)[0, 0].tolist() == [False, True, False, False, False, False]
    turned = beside._replace(heading=torch.tensor([[0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0]]))
    assert find_overlaps(turned, 6)[0, 0].tolist() == [False, True, True, False, False, False]  # 0.95 + 2.25 > 3


def test_driving_as_recorded_is_perfectly_realistic(recording):
    """The record itself as a driver: no divergence, no error, no collision."""
    tick = iter(range(10_000))

    def act(features, memory):
        t = next(tick)
        traffic = at_start(recording)
        m = traffic.drivers
        action = [getattr(recording, n)[:, t].gather(1, traffic.vehicle[:, :m]) for n in ("acceleration", "yaw_rate")]
        return torch.stack(action, dim=-1), None

    rows = torch.arange(3)
    found = measure(recording, act, (rows, torch.zeros_like(rows)), seconds=5.9)
    assert found.vehicles == 18
    assert found.collision == found.off_road == found.hard_brake == found.ever == 0
    assert found.rmse["position"] < 1e-3
    # the record counts a few moments less: those of the car that becomes first of its lane
    assert max(found.divergence.values()) < 0.02


def test_divergence_of_disjoint_laws_is_log_two():
    p = np.array([0.5, 0.5, 0.0, 0.0])
    assert jensen_shannon(p, p) == 0
    assert jensen_shannon(p, p[::-1].copy()) == pytest.approx(math.log(2))
    assert set(BINS) == {"speed", "acceleration", "jerk", "yaw_rate", "inverse_ttc", "gap"}


def test_actions_are_bounded():
    policy = Policy(scaling_of(collect_pairs(stack_scenes(scenes()))))
    action = denormalise_action(policy, torch.tensor([[1e3, -1e3]]))
    assert action.tolist() == [[4.0, pytest.approx(-0.3)]]


def test_features_are_where_the_names_say(recording):
    from rare_envs.sensors.perception import FEATURES

    traffic = at_start(recording)
    features = perceive_traffic(traffic)
    assert len(FEATURES) == features.shape[-1] == 51
    torch.testing.assert_close(features[..., FEATURES.index("speed")], traffic.speed)
    left, right = (features[..., FEATURES.index(name)] for name in ("left_marker", "right_marker"))
    torch.testing.assert_close(left + right, torch.full_like(left, 3.6))
    torch.testing.assert_close(features[..., 0], 0.5 * (left - right))
