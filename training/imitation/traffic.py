"""Traffic of recorded scenes in which some vehicles are driven and the others replayed: differentiable, batch first.

A recording shows a window of a road, so the leader of the first vehicle in each lane is not recorded. That vehicle
is replayed, and continues at constant speed after its record ends; others see it, but it is neither driven nor
judged. Vehicles that enter the window later are left out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rare_envs.sensors.lidar import Bodies, OnRoad, perceive
from training.data.scenes import TrafficScene
from training.data.table import DT

PARKING_X, PARKING_GAP = -1e4, 300.0
"""Position of vehicles that do not exist, beyond the range of any sensor, and their distance from each other [m]."""


class Recording(NamedTuple):
    """S scenes of at most T ticks, V vehicles and L lanes, single precision; units and frame as in `TrafficScene`."""

    x: Tensor
    """Shape (S, T, V), as the next five; 0 where absent."""
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor
    yaw_rate: Tensor
    present: Tensor
    """True where a vehicle is recorded, shape (S, T, V)."""
    acts: Tensor
    """True where its acceleration and yaw rate are known, shape (S, T, V)."""
    length: Tensor
    """Shape (S, V)."""
    width: Tensor
    edges: Tensor
    """Lane boundaries from left to right [m], shape (S, L + 1); beyond the last lane the last edge is repeated."""
    ticks: Tensor
    """Number of ticks of each scene, shape (S,)."""

    def actions(self, scene: Tensor, tick: Tensor | int, vehicle: Tensor) -> Tensor:
        """Return recorded actions of vehicles (B, M) at moments of scenes (B,), shape (B, M, 2)."""
        fields = (self.acceleration, self.yaw_rate)
        return torch.stack([field[scene, tick].gather(1, vehicle) for field in fields], dim=-1)


def stack_scenes(scenes: Sequence[TrafficScene]) -> Recording:
    """Return scenes as one recording.

    Raises:
        ValueError: There is no scene.
    """
    if not scenes:
        raise ValueError("Expected at least one scene, got none.")
    ticks = max(scene.x.shape[0] for scene in scenes)
    vehicles = max(scene.x.shape[1] for scene in scenes)
    lanes = max(len(scene.edges) for scene in scenes)

    def pad(name: str) -> Tensor:
        out = np.zeros((len(scenes), ticks, vehicles), dtype=np.float32)
        for row, scene in zip(out, scenes, strict=True):
            values = getattr(scene, name)  # a field by its name
            row[: values.shape[0], : values.shape[1]] = np.nan_to_num(values)
        return torch.from_numpy(out)

    def sizes(name: str) -> Tensor:
        out = np.ones((len(scenes), vehicles), dtype=np.float32)
        for row, scene in zip(out, scenes, strict=True):
            values = getattr(scene, name)  # likewise
            row[: len(values)] = values
        return torch.from_numpy(out)

    known = np.zeros((len(scenes), ticks, vehicles), dtype=bool)
    for row, scene in zip(known, scenes, strict=True):
        whole = np.isfinite(scene.acceleration) & np.isfinite(scene.yaw_rate) & scene.present
        row[: whole.shape[0], : whole.shape[1]] = whole
    edges = [tuple(scene.edges) + (scene.edges[-1],) * (lanes - len(scene.edges)) for scene in scenes]
    moving = {name: pad(name) for name in ("x", "y", "heading", "speed", "acceleration", "yaw_rate")}
    return Recording(
        **moving,
        present=pad("present") > 0,
        acts=torch.from_numpy(known),
        length=sizes("length"),
        width=sizes("width"),
        edges=torch.tensor(edges, dtype=torch.float32),
        ticks=torch.tensor([scene.x.shape[0] for scene in scenes]),
    )


class Traffic(NamedTuple):
    """Vehicles of B scenes, V each, at one moment; driven vehicles come first."""

    x: Tensor
    """Shape (B, V), as the next three; frame and units as in `TrafficScene`."""
    y: Tensor
    heading: Tensor
    speed: Tensor
    length: Tensor
    """Shape (B, V) [m], as the next."""
    width: Tensor
    edges: Tensor
    """Lane boundaries [m], shape (B, L + 1)."""
    scene: Tensor
    """Scene of the recording, shape (B,)."""
    tick: Tensor
    """Tick of the scene, shape (B,); may pass its end."""
    vehicle: Tensor
    """Vehicle of the scene, shape (B, V)."""
    there: Tensor
    """True for vehicles that exist, shape (B, V); the others are parked far away."""
    driven: Tensor
    """True for vehicles that are driven, shape (B, V)."""

    @property
    def drivers(self) -> int:
        """Number M of first vehicles that holds all driven ones."""
        return int(self.driven.sum(dim=1).max())


def start_replay(recording: Recording, scene: Tensor, tick: Tensor, most: int | None = None) -> Traffic:
    """Return traffic as recorded at a moment of some scenes.

    Args:
        recording: S scenes.
        scene: Scene of each row, shape (B,).
        tick: Tick of each row, shape (B,).
        most: Largest number of driven vehicles in a scene, the rearmost; None for all that can be driven.
    """
    edges = recording.edges[scene]
    there = recording.present[scene, tick]
    x, y = recording.x[scene, tick], recording.y[scene, tick]
    driven = recording.acts[scene, tick] & ~first_in_lane(x, y, there, edges)
    if most is not None:
        rank = torch.where(driven, x, torch.inf).argsort(dim=1).argsort(dim=1)
        driven = driven & (rank < most)
    order = (2 * driven.int() + there.int()).argsort(dim=1, descending=True, stable=True)
    vehicle = order[:, : int(there.sum(dim=1).max())]

    def of(field: Tensor) -> Tensor:
        return field.gather(1, vehicle)

    there, driven = of(there), of(driven)
    x = torch.where(there, of(x), parking_positions(vehicle.float()))
    y, heading, speed = (
        torch.where(there, of(field), 0.0)
        for field in (y, recording.heading[scene, tick], recording.speed[scene, tick])
    )
    sizes = of(recording.length[scene]), of(recording.width[scene])
    return Traffic(x, y, heading, speed, *sizes, edges, scene, tick, vehicle, there, driven)


def parking_positions(like: Tensor) -> Tensor:
    """Return x of vehicles that do not exist [m], of the shape of the given tensor, (..., V)."""
    number = torch.arange(like.shape[-1], dtype=like.dtype, device=like.device)
    return (PARKING_X - PARKING_GAP * number).expand_as(like)


def first_in_lane(x: Tensor, y: Tensor, there: Tensor, edges: Tensor) -> Tensor:
    """Return True for vehicles with nobody ahead in their lane: shapes (B, V) and edges (B, L + 1) -> (B, V)."""
    lane = lane_of(y, edges)
    ahead = (x[:, None, :] > x[:, :, None]) & (lane[:, None, :] == lane[:, :, None]) & there[:, None, :]
    return there & ~ahead.any(dim=2)


def lane_of(y: Tensor, edges: Tensor) -> Tensor:
    """Return the lane of each vehicle, 0 the leftmost, and the nearest if it is off the road: (B, V), (B, L + 1)."""
    inner = torch.where(edges[:, 1:-1] < edges[:, -1:], edges[:, 1:-1], torch.inf)
    return (y.detach()[:, :, None] > inner[:, None, :]).sum(dim=2)


def on_road(y: Tensor, heading: Tensor, edges: Tensor) -> OnRoad:
    """Return the places of vehicles on their straight road; shapes (B, M) and edges (B, L + 1)."""
    lane = lane_of(y, edges)
    left, right = edges.gather(1, lane), edges.gather(1, lane + 1)
    return OnRoad(y - 0.5 * (left + right), heading, torch.zeros_like(y), y - left, right - y)


def replay_features(traffic: Traffic, observers: int | None = None) -> Tensor:
    """Return the 51 features of the first M vehicles, all if None, shape (B, M, 51)."""
    bodies = Bodies(traffic.x, traffic.y, traffic.heading, traffic.speed, traffic.length, traffic.width)
    return perceive(bodies, on_road(traffic.y, traffic.heading, traffic.edges), observers)


def step_replay(recording: Recording, traffic: Traffic, action: Tensor) -> Traffic:
    """Move all vehicles by one tick: explicit Euler with the old values, which `infer_motion` inverts.

    Args:
        recording: The scenes.
        traffic: B scenes with V vehicles.
        action: Acceleration [m/s^2] and yaw rate [rad/s], shape (B, V, 2); only those of driven vehicles count.

    Returns:
        Traffic one tick later, differentiable in traffic and action.
    """
    moving = traffic.driven.to(traffic.x.dtype)
    x = traffic.x + traffic.speed * torch.cos(traffic.heading) * DT
    y = traffic.y + traffic.speed * torch.sin(traffic.heading) * DT * moving
    heading = traffic.heading + action[..., 1] * DT * moving
    speed = traffic.speed + action[..., 0] * DT * moving
    speed = speed + (speed.clamp(min=0.0) - speed).detach()  # the gradient passes a standstill
    moved = {"x": x, "y": y, "heading": heading, "speed": speed}
    tick = traffic.tick + 1
    if not bool(traffic.driven.all()):
        moved = _replay(recording, traffic, tick, moved)
    return traffic._replace(**moved, tick=tick)


def _replay(recording: Recording, traffic: Traffic, tick: Tensor, moved: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the motion with vehicles that are not driven at their recorded places, where the record continues."""
    scene, vehicle = traffic.scene, traffic.vehicle
    at = tick.minimum(recording.ticks[scene] - 1)
    goes_on = recording.present[scene, at].gather(1, vehicle) & (tick == at)[:, None] & traffic.there & ~traffic.driven
    return {
        name: torch.where(goes_on, getattr(recording, name)[scene, at].gather(1, vehicle), value)  # a field by its name
        for name, value in moved.items()
    }
