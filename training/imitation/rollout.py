"""Rollouts of a policy in recorded traffic, with the gradient through the simulator, and what its behaviour costs.

Unwanted behaviour is counted by smooth costs: reward augmentation in the sense of RAIL, whose penalties are steps for
collision and ramps for the rest. Ours are ramps throughout, because a gradient has to grow before a collision. Scenes
are driven on from update to update in pools, so that a policy also meets its own late moments.

References:
    Bhattacharyya et al., "Simulating emergent properties of human driving behavior using multi-agent reward
    augmented imitation learning", 2019.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from agents.learned.networks import AutoregressiveNoise, Policy
from rare_envs.sensors.lidar import AHEAD_BEAM, LANE_OFFSET_COLUMN, RANGE_COLUMNS, RATE_COLUMNS, SPEED_COLUMN
from training.imitation.config import Config
from training.imitation.traffic import Recording, Traffic, replay_features, start_replay, step_replay

NEAR_ALONG, NEAR_ACROSS = 3.0, 0.8
"""Gaps [m] to the front and to the side below which nearness costs."""
MAX_NEARNESS_ALONG, MAX_NEARNESS_ACROSS = 3.0, 4.0
"""Greatest values of the two ramps, reached only by bodies that overlap."""
COMFORTABLE_BRAKING, MAX_EXCESS_BRAKING = 1.5, 6.0
"""Deceleration towards the vehicle ahead that costs nothing, and the greatest above it that counts [m/s^2]."""
BRAKING_SHARE = 0.1
"""Cost of 1 m/s^2 of it, as a share of the cost of collision: closing in costs before contact does."""
LEAST_GAP = 0.5
"""Gap [m] to which smaller ones are raised in the deceleration that is needed."""
EDGE_DISTANCE = 1.0
"""Distance [m] from the middle of the vehicle to the edge of the road below which it costs."""
GENTLE_BRAKING = 2.0
"""Deceleration [m/s^2] of the vehicle itself that costs nothing."""
HEADWAY, STANDSTILL = 1.2, 2.0
"""Gap that costs nothing to vehicles ahead that reach into the own path: so many seconds [s] and metres [m]."""
COMFORTABLE_APPROACH = 3.0
"""Deceleration [m/s^2] by which the own speed first comes down to theirs; the way that this takes is no gap."""
MAX_HEADWAY_COST = 2.0
"""Greatest cost of following closely."""
CENTRE_TOLERANCE = 0.3
"""Distance [m] from the middle of the lane that costs nothing."""
SPEED_LIMIT, SPEEDING_SCALE = 29.0, 10.0
"""Speed that costs nothing, the limit of US 101 (65 mph), and that above it that costs 1 [m/s]."""


ACTION_LOW, ACTION_HIGH = (-8.0, -0.3), (4.0, 0.3)
"""Bounds of acceleration [m/s^2] and yaw rate [rad/s]."""


def denormalise_action(policy: Policy, action: Tensor) -> Tensor:
    """Return normalised actions (..., 2) in m/s^2 and rad/s, clamped to the bounds."""
    scaling = policy.scaling
    low, high = action.new_tensor(ACTION_LOW), action.new_tensor(ACTION_HIGH)
    return (scaling.action_mean + scaling.action_std * action).clamp(low, high)


def normalise_action(policy: Policy, action: Tensor) -> Tensor:
    """Return actions (..., 2) in m/s^2 and rad/s normalised: the inverse of `denormalise_action` within the bounds."""
    return (action - policy.scaling.action_mean) / policy.scaling.action_std


class Penalties(NamedTuple):
    """Costs of vehicles in one tick, shape (B, M) each, or of n moments, shape (n,)."""

    collision: Tensor
    edge: Tensor
    brake: Tensor
    headway: Tensor
    lane: Tensor
    speed: Tensor


def total_cost(config: Config, likeness: Tensor, costs: Penalties) -> Tensor:
    """Return the weighted sum of the critic's cost and the penalties, of each moment or of their means."""
    total = config.critic_weight * likeness
    for name, cost in costs._asdict().items():
        total = total + getattr(config, f"{name}_weight") * cost  # settings by name
    return total


def compute_penalties(traffic: Traffic, features: Tensor, action: Tensor) -> Penalties:
    """Return the costs of a moment of the first M vehicles: features (B, M, 51), action (B, M, 2) [m/s^2, rad/s]."""
    x, y, length, width, edges = traffic.x, traffic.y, traffic.length, traffic.width, traffic.edges
    m = features.shape[1]
    along = (x[:, :m, None] - x[:, None, :]).abs() - 0.5 * (length[:, :m, None] + length[:, None, :])
    across = (y[:, :m, None] - y[:, None, :]).abs() - 0.5 * (width[:, :m, None] + width[:, None, :])
    near = (1.0 - along / NEAR_ALONG).clamp(0.0, MAX_NEARNESS_ALONG) * (1.0 - across / NEAR_ACROSS).clamp(
        0.0, MAX_NEARNESS_ACROSS
    )
    itself = torch.eye(m, x.shape[1], dtype=torch.bool, device=x.device)
    contact = near.masked_fill(itself, 0.0).sum(dim=2)
    gap = (features[..., RANGE_COLUMNS][..., AHEAD_BEAM] - 0.5 * length[:, :m]).clamp(min=LEAST_GAP)
    closing = (-features[..., RATE_COLUMNS][..., AHEAD_BEAM]).clamp(min=0.0)
    needed = closing.square() / (2.0 * gap)
    return Penalties(
        collision=contact + BRAKING_SHARE * (needed - COMFORTABLE_BRAKING).clamp(0.0, MAX_EXCESS_BRAKING),
        edge=(EDGE_DISTANCE - torch.minimum(y[:, :m] - edges[:, :1], edges[:, -1:] - y[:, :m])).clamp(min=0.0),
        brake=(-action[..., 0] - GENTLE_BRAKING).clamp(min=0.0),
        headway=_headway_cost(x, traffic.speed, along, across),
        lane=(features[..., LANE_OFFSET_COLUMN].abs() - CENTRE_TOLERANCE).clamp(min=0.0),
        speed=(features[..., SPEED_COLUMN] - SPEED_LIMIT).clamp(min=0.0) / SPEEDING_SCALE,
    )


def _headway_cost(x: Tensor, speed: Tensor, along: Tensor, across: Tensor) -> Tensor:
    """Return the cost of a short headway to the vehicle ahead, or of closing on it: gaps (B, M, V) -> (B, M)."""
    m = along.shape[1]
    own = speed[:, :m, None]
    approach = (own - speed[:, None, :]).clamp(min=0.0).square() / (2.0 * COMFORTABLE_APPROACH)
    short = 1.0 - (along - approach) / (STANDSTILL + HEADWAY * own)
    reaches = (1.0 - across / NEAR_ACROSS).clamp(0.0, 1.0) * (x[:, None, :] > x[:, :m, None])
    return (short.clamp(0.0, MAX_HEADWAY_COST) * reaches).amax(dim=2)


@dataclass
class ScenePool:
    """Scenes that are driven together."""

    traffic: Traffic
    noise: Tensor
    """Memory of the drivers' noise, shape (B, M, 2, 2)."""
    age: int = 0
    """Number of ticks driven since the record."""


def draw_pool(
    recording: Recording,
    among: Tensor,
    size: int,
    most: int,
    shortest: int,
    colour: AutoregressiveNoise,
    generator: torch.Generator,
) -> ScenePool:
    """Return a pool of `size` scenes among some (k,), at random moments with at least `shortest` ticks of record left.

    At most so many vehicles of each, the rearmost, are driven.
    """
    scene = among[torch.randint(len(among), (size,), generator=generator)]
    last = (recording.ticks[scene] - shortest).clamp(min=1)
    tick = (torch.rand(size, generator=generator).to(last.device) * last).long()
    traffic = start_replay(recording, scene, tick, most)
    noise = colour.begin(torch.randn(size, traffic.drivers, 2, 2, generator=generator).to(last.device))
    return ScenePool(traffic, noise)


class RolloutSteps(NamedTuple):
    """Moments of driven vehicles, n in all: T ticks, each with the same vehicles in the same order."""

    features: Tensor
    """Shape (n, 51), SI units."""
    action: Tensor
    """Normalised, shape (n, 2)."""
    costs: Penalties
    noise: Tensor
    """Expected noise of the action given the ticks before, shape (n, 2)."""


def roll_out(
    recording: Recording,
    policy: Policy,
    pool: ScenePool,
    ticks: int,
    colour: AutoregressiveNoise,
    credit: float,
    generator: torch.Generator,
) -> tuple[RolloutSteps, ScenePool]:
    """Drive a pool for some ticks; return the moments, differentiable in the policy's weights, and the pool afterwards.

    Each tick passes `credit`, a share, of the gradient of the state on to the tick before.
    """
    traffic, memory = pool.traffic, pool.noise
    m = memory.shape[1]
    driven = traffic.driven[:, :m]
    unused = traffic.x.new_zeros(*traffic.x.shape[:1], traffic.x.shape[1] - m, 2)
    rows = []
    for _ in range(ticks):
        features = replay_features(traffic, m)
        mean, log_std = policy(features)
        expected = colour.predict_mean(memory)
        noise, memory = colour.step(memory, torch.randn(expected.shape, generator=generator).to(expected.device))
        action = mean + torch.exp(log_std) * noise
        moved = torch.cat((denormalise_action(policy, action), unused), dim=1)
        cost = compute_penalties(traffic, features, moved[:, :m])
        rows.append([part[driven] for part in (features, action, *cost, expected)])
        traffic = step_replay(recording, traffic, moved)
        scaled = {
            name: (value := getattr(traffic, name)) * credit + value.detach() * (1.0 - credit)  # a field by its name
            for name in ("x", "y", "heading", "speed")
        }
        traffic = traffic._replace(**scaled)
    features, action, *costs, expected = (torch.cat(column) for column in zip(*rows, strict=True))
    left = Traffic(*(field.detach() for field in traffic))
    return RolloutSteps(features, action, Penalties(*costs), expected), ScenePool(left, memory, pool.age + ticks)
