"""Recorded scenes in which a policy drives some vehicles and the others are replayed, and what its behaviour costs.

A recording shows a window of a road, so the leader of the first vehicle in each lane is not recorded. That vehicle
is replayed, and continues at constant speed after its record ends; others see it, but it is neither driven nor
judged. Vehicles that enter the window later are left out. All is differentiable and batch first.

Unwanted behaviour is counted by smooth costs: reward augmentation in the sense of RAIL (Bhattacharyya et al.,
"Simulating emergent properties of human driving behavior using multi-agent reward augmented imitation learning", 2019),
whose penalties are steps for collision and ramps for the rest. Ours are ramps throughout, because a gradient has to
grow before a collision. Scenes are driven on from update to update in pools, so that a policy also meets its own late
moments.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.learned.networks import AutoregressiveNoise, Policy
from rare_envs.sensors.lidar import (
    AHEAD_BEAM,
    RANGE_COLUMNS,
    RATE_COLUMNS,
    Bodies,
    OnRoad,
    perceive,
)
from training.data.scenes import TrafficScene
from training.data.table import DT
from training.imitation.config import Config

PARKING_X, PARKING_GAP = -1e4, 300.0
"""Position of vehicles that do not exist, beyond the range of any sensor, and their distance from each other [m]."""
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
ACTION_LOW, ACTION_HIGH = (-8.0, -0.3), (4.0, 0.3)
"""Bounds of acceleration [m/s^2] and yaw rate [rad/s]."""


class Recording(NamedTuple):
    """S scenes of at most T ticks, V vehicles and L lanes, single precision; units and frame as in `TrafficScene`.

    The first eight have shape (S, T, V): `present` is True if a vehicle is recorded, `acts` where its acceleration
    and yaw rate are known; the others are 0 where it is absent. Sizes have shape (S, V). Lane boundaries, left to right
    (S, L + 1), repeat the last edge beyond the last lane. `ticks` is the number of ticks of each scene (S,).
    """

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor
    yaw_rate: Tensor
    present: Tensor
    acts: Tensor
    length: Tensor
    width: Tensor
    edges: Tensor
    ticks: Tensor

    def actions(self, scene: Tensor, tick: Tensor | int, vehicle: Tensor) -> Tensor:
        """Return recorded actions of vehicles (B, M) at moments of scenes (B,), shape (B, M, 2)."""
        fields = (self.acceleration, self.yaw_rate)
        return torch.stack([field[scene, tick].gather(1, vehicle) for field in fields], dim=-1)


def stack_scenes(scenes: Sequence[TrafficScene]) -> Recording:
    """Return scenes, of which there is one at least, as one recording."""
    if not scenes:
        raise ValueError("Expected at least one scene, got none.")
    ticks, vehicles = (max(scene.x.shape[axis] for scene in scenes) for axis in (0, 1))
    lanes = max(len(scene.edges) for scene in scenes)

    def pad(parts: Sequence[NDArray[Any]], shape: tuple[int, ...], fill: float = 0.0) -> Tensor:
        out = np.full((len(parts), *shape), fill, bool if parts[0].dtype == bool else np.float32)
        for row, values in zip(out, parts, strict=True):
            row[tuple(slice(n) for n in values.shape)] = np.nan_to_num(values)
        return torch.from_numpy(out)

    moving = ("x", "y", "heading", "speed", "acceleration", "yaw_rate", "present")  # fields by name, as the next
    edges = [tuple(scene.edges) + (scene.edges[-1],) * (lanes - len(scene.edges)) for scene in scenes]
    return Recording(
        **{name: pad([getattr(scene, name) for scene in scenes], (ticks, vehicles)) for name in moving},
        acts=pad([scene.acted & np.isfinite(scene.yaw_rate) for scene in scenes], (ticks, vehicles)),
        **{name: pad([getattr(scene, name) for scene in scenes], (vehicles,), 1.0) for name in ("length", "width")},
        edges=torch.tensor(edges, dtype=torch.float32),
        ticks=torch.tensor([scene.x.shape[0] for scene in scenes]),
    )


class Traffic(NamedTuple):
    """Vehicles of B scenes, V each, at one moment, driven ones first; frame and units as in `TrafficScene`.

    Shapes are (B, V) but for the lane boundaries (B, L + 1), scene and tick (B,), which may pass the scene's end.
    `vehicle` is the number in the scene, `there` True for vehicles that exist (the others are parked far away), and
    `driven` for those that are driven.
    """

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    length: Tensor
    width: Tensor
    edges: Tensor
    scene: Tensor
    tick: Tensor
    vehicle: Tensor
    there: Tensor
    driven: Tensor

    @property
    def drivers(self) -> int:
        """Number M of first vehicles that holds all driven ones."""
        return int(self.driven.sum(dim=1).max())


def start_replay(recording: Recording, scene: Tensor, tick: Tensor, most: int | None = None) -> Traffic:
    """Return traffic as recorded at ticks (B,) of scenes (B,).

    In each at most so many vehicles are driven, the rearmost; with None all that can be.
    """
    edges = recording.edges[scene]
    there = recording.present[scene, tick]
    x, y = recording.x[scene, tick], recording.y[scene, tick]
    lane = lane_of(y, edges)
    ahead = (x[:, None, :] > x[:, :, None]) & (lane[:, None, :] == lane[:, :, None]) & there[:, None, :]
    driven = recording.acts[scene, tick] & ahead.any(dim=2)  # nor is the first in its lane
    if most is not None:
        rank = torch.where(driven, x, torch.inf).argsort(dim=1).argsort(dim=1)
        driven = driven & (rank < most)
    order = (2 * driven.int() + there.int()).argsort(dim=1, descending=True, stable=True)
    vehicle = order[:, : int(there.sum(dim=1).max())]

    def of(field: Tensor) -> Tensor:
        return field.gather(1, vehicle)

    there, driven = of(there), of(driven)
    parking = PARKING_X - PARKING_GAP * torch.arange(vehicle.shape[1], dtype=x.dtype, device=x.device)
    x = torch.where(there, of(x), parking)
    y, heading, speed = (
        torch.where(there, of(field), 0.0)
        for field in (y, recording.heading[scene, tick], recording.speed[scene, tick])
    )
    sizes = of(recording.length[scene]), of(recording.width[scene])
    return Traffic(x, y, heading, speed, *sizes, edges, scene, tick, vehicle, there, driven)


def lane_of(y: Tensor, edges: Tensor) -> Tensor:
    """Return the lane of each vehicle, 0 the leftmost, and the nearest if it is off the road: (B, V), (B, L + 1)."""
    inner = torch.where(edges[:, 1:-1] < edges[:, -1:], edges[:, 1:-1], torch.inf)
    return (y.detach()[:, :, None] > inner[:, None, :]).sum(dim=2)


def replay_features(traffic: Traffic, observers: int | None = None) -> Tensor:
    """Return the 51 features of the first M vehicles, all if None, on their straight road, shape (B, M, 51)."""
    y, lane = traffic.y, lane_of(traffic.y, traffic.edges)
    left, right = traffic.edges.gather(1, lane), traffic.edges.gather(1, lane + 1)
    place = OnRoad(y - 0.5 * (left + right), traffic.heading, torch.zeros_like(y), y - left, right - y)
    bodies = Bodies(traffic.x, y, traffic.heading, traffic.speed, traffic.length, traffic.width)
    return perceive(bodies, place, observers)


def step_replay(recording: Recording, traffic: Traffic, action: Tensor) -> Traffic:
    """Return traffic one tick later, differentiable: explicit Euler, which `infer_motion` inverts.

    Of the actions (B, V, 2) [m/s^2, rad/s] those of driven vehicles count; others follow the record while it goes on.
    """
    moving = traffic.driven.to(traffic.x.dtype)
    x = traffic.x + traffic.speed * torch.cos(traffic.heading) * DT
    y = traffic.y + traffic.speed * torch.sin(traffic.heading) * DT * moving
    heading = traffic.heading + action[..., 1] * DT * moving
    speed = traffic.speed + action[..., 0] * DT * moving
    speed = speed + (speed.clamp(min=0.0) - speed).detach()  # the gradient passes a standstill
    moved, tick = {"x": x, "y": y, "heading": heading, "speed": speed}, traffic.tick + 1
    if not bool(traffic.driven.all()):
        at = tick.minimum(recording.ticks[traffic.scene] - 1)

        def recorded(name: str) -> Tensor:
            values: Tensor = getattr(recording, name)[traffic.scene, at]  # a field by its name
            return values.gather(1, traffic.vehicle)

        goes_on = recorded("present") & (tick == at)[:, None] & traffic.there & ~traffic.driven
        moved = {name: torch.where(goes_on, recorded(name), value) for name, value in moved.items()}
    return traffic._replace(**moved, tick=tick)


class Pairs(NamedTuple):
    """Features and actions of n moments of recorded driving."""

    features: Tensor
    """Shape (n, 51), SI units."""
    action: Tensor
    """Acceleration [m/s^2] and yaw rate [rad/s], shape (n, 2)."""
    scene: Tensor
    """Scene of each moment, shape (n,)."""


def collect_pairs(recording: Recording) -> Pairs:
    """Return every moment of every vehicle whose surroundings and action are known."""
    rows = []
    for tick in range(recording.x.shape[1]):
        scene = (tick < recording.ticks).nonzero().flatten()
        traffic = start_replay(recording, scene, torch.full_like(scene, tick))
        m = traffic.drivers
        driven, action = traffic.driven[:, :m], recording.actions(scene, tick, traffic.vehicle[:, :m])
        rows.append((replay_features(traffic, m)[driven], action[driven], scene[:, None].expand_as(driven)[driven]))
    return Pairs(*(torch.cat(column) for column in zip(*rows, strict=True)))


def normalise_action(policy: Policy, action: Tensor) -> Tensor:
    """Return actions (..., 2) in m/s^2 and rad/s normalised by the record's means and spreads."""
    return (action - policy.scaling.action_mean) / policy.scaling.action_std


class Penalties(NamedTuple):
    """Costs of vehicles in one tick, shape (B, M) each, or of n moments, shape (n,)."""

    collision: Tensor
    edge: Tensor
    brake: Tensor


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
    )


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
    bounds, rows = (unused.new_tensor(ACTION_LOW), unused.new_tensor(ACTION_HIGH)), []
    for _ in range(ticks):
        features = replay_features(traffic, m)
        mean, log_std = policy(features)
        expected = colour.predict_mean(memory)
        noise, memory = colour.step(memory, torch.randn(expected.shape, generator=generator).to(expected.device))
        action = mean + torch.exp(log_std) * noise
        physical = (policy.scaling.action_mean + policy.scaling.action_std * action).clamp(*bounds)
        moved = torch.cat((physical, unused), dim=1)
        cost = compute_penalties(traffic, features, physical)
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
