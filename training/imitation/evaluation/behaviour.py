"""Behaviour of vehicles in recorded scenes, tick by tick: driven by one driver, or as recorded."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from agents import LearnedDriver
from rare_envs.sensors.lidar import AHEAD_BEAM
from rare_envs.sensors.perception import RANGE_COLUMNS, RATE_COLUMNS
from rare_envs.traffic.bodies import boxes_overlap
from training.data.trajectories import DT
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import Traffic, lane_of, replay_features, start_replay, step_replay

Act = Callable[[Tensor, "Tensor | None"], tuple[Tensor, "Tensor | None"]]
"""Function from features (B, M, 51) and a memory, None at first, to actions (B, M, 2) [m/s^2, rad/s] and the new
memory."""
HARD_BRAKE_ACCELERATION = -3.0
"""Acceleration [m/s^2] from which on a brake is hard."""


class Behaviour(NamedTuple):
    """Motion and contacts of n vehicles in T ticks; shapes (T, n) unless said, NaN where a value is not known."""

    scene: Tensor
    """Scene of each vehicle, shape (n,)."""
    known: Tensor
    """True where the vehicle is there and counts; elsewhere its other values mean nothing."""
    speed: Tensor
    """[m/s]."""
    acceleration: Tensor
    """[m/s^2]."""
    yaw_rate: Tensor
    """[rad/s]."""
    ahead: Tensor
    """Range of the beam ahead [m]."""
    rate: Tensor
    """Range rate of the beam ahead [m/s]."""
    contact: Tensor
    """True where its body overlaps with another that it did not overlap with at the start."""
    off_road: Tensor
    """True where its middle is beyond the edge of the road."""
    changed: Tensor
    """True where its lane differs from that of the tick before."""


def sampling_driver(driver: LearnedDriver, generator: torch.Generator, weights: Tensor | None = None) -> Act:
    """Return a function that draws the actions of a learned driver, with its noise.

    Args:
        driver: The driver.
        generator: Source of the noise.
        weights: Last layers of each scene, shape (B, 404), or of all, shape (404,); None for the driver's own.

    Example:
        >>> from agents import load_driver
        >>> act = sampling_driver(load_driver("mgail"), torch.Generator().manual_seed(0))
        >>> actions, memory = act(torch.zeros(1, 3, 51), None)
        >>> actions.shape
        torch.Size([1, 3, 2])
    """

    def act(features: Tensor, memory: Tensor | None) -> tuple[Tensor, Tensor | None]:
        draws = (*features.shape[:2], 2)
        if memory is None:
            memory = driver.begin(torch.randn(*draws, 2, generator=generator))
        last = None if weights is None else weights.expand(len(features), -1)
        return driver.act(features, last, torch.randn(draws, generator=generator), memory)

    return act


def regular_starts(recording: Recording, seconds: float = 2.0) -> tuple[Tensor, Tensor]:
    """Return scenes and ticks of starts every few seconds from the start of every scene, shape (B,) each."""
    stride = round(seconds / DT)
    starts = [
        (scene, tick) for scene, ticks in enumerate(recording.ticks.tolist()) for tick in range(0, ticks - 1, stride)
    ]
    return torch.tensor([scene for scene, _ in starts]), torch.tensor([tick for _, tick in starts])


class DrivingStep(NamedTuple):
    """Traffic at one tick, and the actions taken in it."""

    traffic: Traffic
    """Traffic before the action."""
    features: Tensor
    """Features of the first M vehicles, shape (B, M, 51)."""
    action: Tensor
    """Actions of the first M vehicles, shape (B, M, 2)."""


def drive_traffic(recording: Recording | None, traffic: Traffic, act: Act, ticks: int) -> Iterator[DrivingStep]:
    """Drive traffic tick by tick.

    Args:
        recording: The scenes, from which vehicles that are not driven are replayed; None if there are none.
        traffic: Traffic to start from.
        act: Driver of all driven vehicles.
        ticks: Number of ticks.

    Yields:
        Each tick, before its action.
    """
    m = traffic.drivers
    unused = torch.zeros(*traffic.x.shape[:1], traffic.x.shape[1] - m, 2)
    memory = None
    for _ in range(ticks):
        features = replay_features(traffic, m)
        action, memory = act(features, memory)
        yield DrivingStep(traffic, features, action)
        traffic = step_replay(recording, traffic, torch.cat((action, unused), dim=1))


def find_overlaps(traffic: Traffic, m: int) -> Tensor:
    """Return True for pairs of bodies that overlap: the first m vehicles with all, shape (B, m, V)."""

    def each(field: Tensor) -> Tensor:
        return field[:, :m, None]

    def other(field: Tensor) -> Tensor:
        return field[:, None, :]

    touching = boxes_overlap(
        other(traffic.x) - each(traffic.x),
        other(traffic.y) - each(traffic.y),
        each(traffic.heading),
        other(traffic.heading),
        (each(traffic.length), each(traffic.width)),
        (other(traffic.length), other(traffic.width)),
    )
    return touching & ~torch.eye(m, traffic.x.shape[1], dtype=torch.bool)


def behaviour_of(moments: Iterator[DrivingStep]) -> Behaviour:
    """Return the behaviour of driven vehicles from a start on."""
    rows: list[tuple[Tensor, ...]] = []
    driven = overlapping = lane = torch.zeros(0)
    scene = torch.zeros(0)
    with torch.inference_mode():
        for moment in moments:
            traffic, m = moment.traffic, moment.action.shape[1]
            now, touching = lane_of(traffic.y, traffic.edges)[:, :m], find_overlaps(traffic, m)
            if not rows:
                driven, overlapping, lane = traffic.driven[:, :m], touching, now
                scene = traffic.scene[:, None].expand_as(driven)[driven]
            row = _row(moment, (touching & ~overlapping).any(dim=2), now != lane)
            rows.append(tuple(column[driven] for column in row))
            lane = now
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    return Behaviour(scene, torch.ones_like(columns[0], dtype=torch.bool), *columns)


def recorded_behaviour(recording: Recording) -> Behaviour:
    """Return the behaviour of people: every vehicle of the record at every tick at which it could have been driven.

    Overlaps in the record are errors of measurement and count as contact.
    """
    scenes, _, vehicles = recording.x.shape
    known, rows = [], []
    before = torch.full((scenes, vehicles), -1)
    for tick in range(int(recording.ticks.max())):
        scene = torch.arange(scenes)
        at = recording.ticks.clamp(max=tick + 1) - 1
        traffic = start_replay(recording, scene, at)
        m = traffic.drivers
        action = torch.stack(
            [
                field[scene, at].gather(1, traffic.vehicle[:, :m])
                for field in (recording.acceleration, recording.yaw_rate)
            ],
            dim=-1,
        )
        moment = DrivingStep(traffic, replay_features(traffic, m), action)
        lane = lane_of(traffic.y, traffic.edges)[:, :m]
        vehicle = traffic.vehicle[:, :m]
        driven = traffic.driven[:, :m] & (at == tick)[:, None]
        last = before.gather(1, vehicle)
        row = _row(moment, find_overlaps(traffic, m).any(dim=2), (lane != last) & (last >= 0))
        known.append(torch.zeros(scenes, vehicles, dtype=torch.bool).scatter(1, vehicle, driven).flatten())
        rows.append([column.new_zeros(scenes, vehicles).scatter(1, vehicle, column).flatten() for column in row])
        before = torch.full_like(before, -1).scatter(1, vehicle, torch.where(driven, lane, -1))
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    return Behaviour(torch.arange(scenes).repeat_interleave(vehicles), torch.stack(known), *columns)


def _row(moment: DrivingStep, contact: Tensor, changed: Tensor) -> tuple[Tensor, ...]:
    """Return the columns of `Behaviour` from `speed` on, shape (B, M) each."""
    traffic, m = moment.traffic, moment.action.shape[1]
    y = traffic.y[:, :m]
    return (
        traffic.speed[:, :m],
        moment.action[..., 0],
        moment.action[..., 1],
        moment.features[..., RANGE_COLUMNS][..., AHEAD_BEAM],
        moment.features[..., RATE_COLUMNS][..., AHEAD_BEAM],
        contact,
        (y < traffic.edges[:, :1]) | (y > traffic.edges[:, -1:]),
        changed,
    )
