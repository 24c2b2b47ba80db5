"""How human a driver is: all vehicles of recorded scenes driven by it, compared with the record.

Rates are per vehicle-step, as in RAIL; `ever` counts vehicles. Divergences are Jensen-Shannon, in nats, over fixed bins
that fit smoothed data; Kuefler et al.'s are far wider.

References:
    Kuefler, Morton, Wheeler and Kochenderfer, "Imitating driver behavior with generative adversarial networks", 2017.
    Bhattacharyya et al., "Simulating emergent properties of human driving behavior using multi-agent reward augmented
    imitation learning", 2019.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents import LearnedDriver
from rare_envs.lidar import AHEAD, MAX_RANGE
from rare_envs.perception import RANGES, RATES
from training.imitation.recording import Recording
from training.imitation.traffic import DT, Traffic, lane_of, look, start, step

Array = NDArray[np.float64]

HARD_BRAKE = -3.0
"""Acceleration [m/s^2]."""
BINS = MappingProxyType(
    {
        "speed": (0.0, 30.0, 60),
        "acceleration": (-5.0, 4.0, 60),
        "jerk": (-12.0, 12.0, 60),
        "yaw_rate": (-0.12, 0.12, 60),
        "inverse_ttc": (-1.0, 1.0, 60),
        "gap": (0.0, 100.0, 50),
    }
)
"""Lowest and highest edge and number of bins of each quantity; what is beyond counts in the outermost bin. Units are
m/s, m/s^2, m/s^3, rad/s, 1/s (range rate over range of the beam ahead) and m (of that beam)."""

Act = Callable[[Tensor, "Tensor | None"], tuple[Tensor, "Tensor | None"]]
"""From features (B, M, 51) and a memory, None at first, to actions (B, M, 2) [m/s^2, rad/s] and the new memory."""


class Moment(NamedTuple):
    """The driven vehicles at one tick; shapes (B, M)."""

    traffic: Traffic
    """As it is when the action is taken."""
    features: Tensor
    action: Tensor


def every(recording: Recording, seconds: float = 2.0) -> tuple[Tensor, Tensor]:
    """Starts: (scene, tick) at whole multiples of some seconds from the start of every scene, shape (B,) each."""
    stride = round(seconds / DT)
    found = [
        (scene, tick) for scene, ticks in enumerate(recording.ticks.tolist()) for tick in range(0, ticks - 1, stride)
    ]
    return torch.tensor([scene for scene, _ in found]), torch.tensor([tick for _, tick in found])


def drive(recording: Recording, starts: tuple[Tensor, Tensor], act: Act, ticks: int) -> Iterator[Moment]:
    """Drive all scenes from their starts, tick by tick."""
    traffic = start(recording, *starts)
    m = traffic.drivers
    unused = torch.zeros(*traffic.x.shape[:1], traffic.x.shape[1] - m, 2)
    memory = None
    for _ in range(ticks):
        features = look(traffic, m)
        action, memory = act(features, memory)
        yield Moment(traffic, features, action)
        traffic = step(recording, traffic, torch.cat((action, unused), dim=1))


def overlaps(traffic: Traffic, m: int) -> Tensor:
    """Which pairs of bodies share ground: the first m vehicles with all, boolean, shape (B, m, V)."""
    half_length, half_width = 0.5 * traffic.length, 0.5 * traffic.width
    dx = traffic.x[:, None, :] - traffic.x[:, :m, None]
    dy = traffic.y[:, None, :] - traffic.y[:, :m, None]
    own, other = traffic.heading[:, :m, None], traffic.heading[:, None, :]
    cos, sin = torch.cos(other - own).abs(), torch.sin(other - own).abs()
    sizes = half_length[:, :m, None], half_width[:, :m, None], half_length[:, None, :], half_width[:, None, :]
    apart = torch.zeros_like(dx, dtype=torch.bool)
    for heading, (length, width, its_length, its_width) in (
        (own, sizes),
        (other, (sizes[2], sizes[3], sizes[0], sizes[1])),
    ):
        along = dx * torch.cos(heading) + dy * torch.sin(heading)
        across = dy * torch.cos(heading) - dx * torch.sin(heading)
        apart = apart | (along.abs() >= length + its_length * cos + its_width * sin)
        apart = apart | (across.abs() >= width + its_length * sin + its_width * cos)
    itself = torch.eye(m, traffic.x.shape[1], dtype=torch.bool)
    return ~apart & ~itself


@dataclass(frozen=True)
class Realism:
    """What a driver does in recorded scenes within some seconds."""

    seconds: float
    vehicles: int
    hard_brake: float
    """Share of vehicle-steps."""
    collision: float
    """Share of vehicle-steps in which bodies overlap; pairs that overlap at the start are left out."""
    ever: float
    """Share of vehicles that collide at all."""
    off_road: float
    """Share of vehicle-steps with the middle of the vehicle beyond the edge."""
    lane_changes: float
    """Per vehicle and 10 s."""
    mean_speed: float
    """[m/s]."""
    divergence: dict[str, float]
    """Jensen-Shannon divergence from the record [nats], of each quantity in `BINS`."""
    rmse: dict[str, float]
    """Root mean square error against the record after 5 s: position [m], speed [m/s], lateral [m]."""
    scene_collision: tuple[float, ...]
    """Colliding share of vehicle-steps by scene, for bootstrap over scenes."""


def histograms(values: dict[str, list[Tensor]]) -> dict[str, Array]:
    """Shares of the bins of each quantity."""
    out = {}
    for name, (low, high, bins) in BINS.items():
        edges = np.linspace(low, high, bins + 1)
        inside = np.clip(torch.cat(values[name]).double().numpy(), low, high)
        counts, _ = np.histogram(inside, edges)
        out[name] = counts / max(counts.sum(), 1)
    return out


def jensen_shannon(p: Array, q: Array) -> float:
    """Divergence of two laws on the same bins [nats], 0 to log 2."""
    middle = 0.5 * (p + q)

    def kl(a: Array) -> float:
        inside = a > 0
        return float((a[inside] * np.log(a[inside] / middle[inside])).sum())

    return 0.5 * kl(p) + 0.5 * kl(q)


def quantities(
    moment: Moment, driven: Tensor, before: Tensor | None = None, known: Tensor | None = None
) -> dict[str, Tensor]:
    """The quantities of `BINS` at a moment.

    Args:
        moment: M vehicles.
        driven: Which of them count, shape (B, M).
        before: Their accelerations one tick earlier, for the jerk; None if there is no such tick.
        known: Whose earlier acceleration is known; None for all.
    """
    acceleration, yaw_rate = moment.action[..., 0], moment.action[..., 1]
    ahead = moment.features[..., RANGES][..., AHEAD]
    rate = moment.features[..., RATES][..., AHEAD]
    out = {
        "speed": moment.traffic.speed[:, : driven.shape[1]][driven],
        "acceleration": acceleration[driven],
        "jerk": acceleration.new_zeros(0),
        "yaw_rate": yaw_rate[driven],
        "inverse_ttc": (-rate / ahead.clamp(min=0.1))[driven & (ahead < MAX_RANGE)],
        "gap": ahead[driven],
    }
    if before is not None:
        out["jerk"] = ((acceleration - before) / DT)[driven if known is None else driven & known]
    return out


def recorded_histograms(recording: Recording) -> dict[str, Array]:
    """The quantities of `BINS` in the record itself: every vehicle that may be driven, at every moment."""
    values: dict[str, list[Tensor]] = {name: [] for name in BINS}
    for tick in range(int(recording.ticks.max())):
        scene = (tick < recording.ticks).nonzero().flatten()
        traffic = start(recording, scene, torch.full_like(scene, tick))
        m = traffic.drivers
        vehicle = traffic.vehicle[:, :m]

        def of(field: Tensor, at: int, scene: Tensor = scene, vehicle: Tensor = vehicle) -> Tensor:
            return field[scene, at].gather(1, vehicle)

        action = torch.stack((of(recording.acceleration, tick), of(recording.yaw_rate, tick)), dim=-1)
        moment = Moment(traffic, look(traffic, m), action)
        before, known = None, None
        if tick:
            before, known = of(recording.acceleration, tick - 1), of(recording.acts, tick - 1)
        for name, value in quantities(moment, traffic.driven[:, :m], before, known).items():
            values[name].append(value)
    return histograms(values)


def measure(
    recording: Recording, act: Act, starts: tuple[Tensor, Tensor] | None = None, seconds: float = 10.0
) -> Realism:
    """Drive recorded scenes and compare with the record.

    Args:
        recording: Scenes that the driver has not learned from.
        act: The driver of all vehicles.
        starts: Scenes and ticks to start from; None for every 2 s of every scene.
        seconds: How long.
    """
    starts = every(recording) if starts is None else starts
    ticks = round(seconds / DT)
    values: dict[str, list[Tensor]] = {name: [] for name in BINS}
    errors: dict[str, Tensor] = {}
    before: Tensor | None = None
    driven = overlapping = lane = torch.zeros(0)
    hard, contact, away, changes = [], [], [], []
    with torch.inference_mode():
        for tick, moment in enumerate(drive(recording, starts, act, ticks)):
            traffic = moment.traffic
            m = moment.action.shape[1]
            now = lane_of(traffic.y, traffic.edges)[:, :m]
            touching = overlaps(traffic, m)
            if tick == 0:
                driven, overlapping, lane = traffic.driven[:, :m], touching, now
            contact.append((touching & ~overlapping).any(dim=2) & driven)
            hard.append((moment.action[..., 0] <= HARD_BRAKE) & driven)
            y = traffic.y[:, :m]
            away.append(((y < traffic.edges[:, :1]) | (y > traffic.edges[:, -1:])) & driven)
            changes.append((now != lane) & driven)
            lane = now
            for name, value in quantities(moment, driven, before).items():
                values[name].append(value)
            before = moment.action[..., 0]
            if tick == round(5.0 / DT):
                errors = _errors(recording, traffic, driven)
        shares = histograms(values)
        recorded = recorded_histograms(recording)
    crashed = torch.stack(contact)
    steps = driven.sum() * ticks
    by_scene = tuple(
        float(crashed[:, rows].sum() / (driven[rows].sum() * ticks))
        for scene in torch.unique(starts[0])
        if driven[rows := starts[0] == scene].any()
    )
    return Realism(
        seconds=seconds,
        vehicles=int(driven.sum()),
        hard_brake=float(torch.stack(hard).sum() / steps),
        collision=float(crashed.sum() / steps),
        ever=float(crashed.any(dim=0).sum() / driven.sum()),
        off_road=float(torch.stack(away).sum() / steps),
        lane_changes=float(torch.stack(changes).sum() / driven.sum()) * 10.0 / seconds,
        mean_speed=float(torch.cat(values["speed"]).mean()),
        divergence={name: jensen_shannon(shares[name], recorded[name]) for name in BINS},
        rmse={name: float(error.square().mean().sqrt()) for name, error in errors.items()},
        scene_collision=by_scene,
    )


def sampled(driver: LearnedDriver, generator: torch.Generator, weights: Tensor | None = None) -> Act:
    """A learned driver with its noise, ready for `measure`.

    Args:
        driver: The driver.
        generator: Source of the noise.
        weights: Last layers, shape (404,); None for the driver's own.
    """

    def act(features: Tensor, memory: Tensor | None) -> tuple[Tensor, Tensor | None]:
        draws = (*features.shape[:2], 2)
        if memory is None:
            memory = driver.begin(torch.randn(*draws, 2, generator=generator))
        last = None if weights is None else weights.expand(len(features), -1)
        return driver.act(features, last, torch.randn(draws, generator=generator), memory)

    return act


def metrics(recording: Recording, driver: LearnedDriver, seed: int = 0) -> dict[str, dict[str, Any]]:
    """What the header of a driver's file says: `measure` over 10 s and 20 s, with one sequence of noise."""
    out = {}
    for seconds in (10.0, 20.0):
        found = asdict(measure(recording, sampled(driver, torch.Generator().manual_seed(seed)), seconds=seconds))
        del found["scene_collision"], found["seconds"]
        if not np.isfinite(found["rmse"].get("position", np.nan)):
            del found["rmse"]  # the record is over after 5 s
        out[f"{seconds:g} s"] = found
    return out


def _errors(recording: Recording, traffic: Traffic, driven: Tensor) -> dict[str, Tensor]:
    """Differences from the record, of driven vehicles that it still has."""
    m = driven.shape[1]
    at = traffic.tick.minimum(recording.ticks[traffic.scene] - 1)
    recorded = recording.present[traffic.scene, at].gather(1, traffic.vehicle)[:, :m]
    known = recorded & driven & (traffic.tick == at)[:, None]

    def off(name: str) -> Tensor:
        record: Tensor = getattr(recording, name)[traffic.scene, at].gather(1, traffic.vehicle)
        made: Tensor = getattr(traffic, name)
        return (made - record)[:, :m][known]

    along, across = off("x"), off("y")
    return {"position": (along.square() + across.square()).sqrt(), "speed": off("speed"), "lateral": across}
