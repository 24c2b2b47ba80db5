"""How a driver behaves in recorded scenes, all vehicles driven by it, compared with the people in them.

Rates are per vehicle-step, as in RAIL; `ever` counts vehicles. Divergences are Jensen-Shannon, in nats, over fixed
bins that fit smoothed data; Kuefler et al.'s bins are far wider.

References:
    Kuefler, Morton, Wheeler and Kochenderfer, "Imitating driver behavior with generative adversarial networks",
    2017. Bhattacharyya et al., "Simulating emergent properties of human driving behavior using multi-agent reward
    augmented imitation learning", 2019.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.special import rel_entr
from torch import Tensor

from agents import LearnedDriver
from rare_envs.sensors.lidar import AHEAD_BEAM, MAX_RANGE, RANGE_COLUMNS, RATE_COLUMNS
from rare_envs.traffic.bodies import boxes_overlap
from samplers.problem import FloatArray
from training.data.table import DT
from training.imitation.traffic import Recording, Traffic, lane_of, replay_features, start_replay, step_replay

Act = Callable[[Tensor, "Tensor | None"], tuple[Tensor, "Tensor | None"]]
"""From features (B, M, 51) and a memory, None at first, to actions (B, M, 2) [m/s^2, rad/s] and the new memory."""
HARD_BRAKE_ACCELERATION = -3.0
"""Acceleration [m/s^2] from which on a brake is hard."""
ERROR_TIME = 5.0
"""Time [s] after which positions are compared with the record, all vehicles driven."""
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
"""Lowest and highest edge and number of bins of each quantity; values beyond count in the outermost bin. Units are m/s,
m/s^2, m/s^3, rad/s, 1/s (closing speed over range of the beam ahead) and m (of that beam)."""
LEAST_RANGE = 0.1
"""Range of the beam ahead [m] to which shorter ones are raised before it divides the closing speed."""
SHARES = ("hard_brake", "collision", "off_road")
ERROR_NAMES = ("position", "speed", "lateral")
"""Errors against the record."""


def sampling_driver(driver: LearnedDriver, generator: torch.Generator, weights: Tensor | None = None) -> Act:
    """Return a function that draws the actions of a learned driver, with noise of a generator.

    Weights are last layers of each scene, shape (B, 404), or of all, shape (404,); None for the driver's own.

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


def regular_starts(recording: Recording) -> tuple[Tensor, Tensor]:
    """Return scenes and ticks of starts every 2 s from the start of every scene, shape (B,) each."""
    stride = round(2.0 / DT)
    starts = [(scene, at) for scene, ticks in enumerate(recording.ticks.tolist()) for at in range(0, ticks - 1, stride)]
    scene, tick = torch.tensor(starts).T
    return scene, tick


class Behaviour(NamedTuple):
    """Motion and contacts of n vehicles, of a scene each (n,), in T ticks: shapes (T, n).

    `known` is True if a vehicle is there and counts; elsewhere its other values mean nothing. Units are m/s, m/s^2
    and rad/s; `ahead` and `rate` are the range [m] and range rate [m/s] of the beam ahead. `contact` is True where its
    body overlaps with another that it did not overlap with at the start, `off_road` where its middle is beyond the edge
    of the road, `changed` where its lane differs from that of the tick before.
    """

    scene: Tensor
    known: Tensor
    speed: Tensor
    acceleration: Tensor
    yaw_rate: Tensor
    ahead: Tensor
    rate: Tensor
    contact: Tensor
    off_road: Tensor
    changed: Tensor


def find_overlaps(traffic: Traffic, m: int) -> Tensor:
    """Return True for pairs of bodies that overlap: the first m vehicles with all, shape (B, m, V)."""
    x, y, heading, length, width = (
        (field[:, :m, None], field[:, None, :])
        for field in (traffic.x, traffic.y, traffic.heading, traffic.length, traffic.width)
    )
    sizes = zip(length, width, strict=True)
    touching = boxes_overlap(x[1] - x[0], y[1] - y[0], *heading, *sizes)
    return touching & ~torch.eye(m, traffic.x.shape[1], dtype=torch.bool)


def drive_recording(
    recording: Recording, act: Act, ticks: int, starts: tuple[Tensor, Tensor]
) -> tuple[Behaviour, dict[str, Tensor] | None]:
    """Return the behaviour of driven vehicles from some starts on, and their errors after `ERROR_TIME` if it lasts.

    Errors are differences from the record of the n vehicles that are still recorded: position and lateral [m], speed
    [m/s], (n,) each, and the scene of each vehicle.
    """
    traffic, memory, errors = start_replay(recording, *starts), None, None
    m = traffic.drivers
    driven, unused = traffic.driven[:, :m], torch.zeros(len(traffic.x), traffic.x.shape[1] - m, 2)
    overlapping, lane = find_overlaps(traffic, m), lane_of(traffic.y, traffic.edges)[:, :m]
    rows = []
    for tick in range(ticks):
        if tick == round(ERROR_TIME / DT):
            at = traffic.tick.minimum(recording.ticks[traffic.scene] - 1)
            recorded = recording.present[traffic.scene, at].gather(1, traffic.vehicle)
            known = recorded & traffic.driven & (traffic.tick == at)[:, None]
            along, across, speed = (
                (getattr(traffic, name) - getattr(recording, name)[traffic.scene, at].gather(1, traffic.vehicle))[known]
                for name in ("x", "y", "speed")  # fields by name
            )
            position = (along.square() + across.square()).sqrt()
            scene = traffic.scene[:, None].expand_as(known)[known]
            errors = {"scene": scene, "position": position, "speed": speed, "lateral": across}
        features = replay_features(traffic, m)
        action, memory = act(features, memory)
        contact = (find_overlaps(traffic, m) & ~overlapping).any(dim=2)
        before, lane = lane, lane_of(traffic.y, traffic.edges)[:, :m]
        rows.append([column[driven] for column in _row(traffic, features, action, contact, lane != before)])
        traffic = step_replay(recording, traffic, torch.cat((action, unused), dim=1))
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    scene = traffic.scene[:, None].expand_as(driven)[driven]
    return Behaviour(scene, torch.ones_like(columns[0], dtype=torch.bool), *columns), errors


def recorded_behaviour(recording: Recording) -> Behaviour:
    """Return the behaviour of people: every vehicle of the record at every tick at which it could have been driven.

    Overlaps in the record are errors of measurement and count as contact.
    """
    scenes, _, vehicles = recording.x.shape
    known, rows = [], []
    before, scene = torch.full((scenes, vehicles), -1), torch.arange(scenes)
    for tick in range(int(recording.ticks.max())):
        at = recording.ticks.clamp(max=tick + 1) - 1
        traffic = start_replay(recording, scene, at)
        m = traffic.drivers
        vehicle = traffic.vehicle[:, :m]
        features, action = replay_features(traffic, m), recording.actions(scene, at, vehicle)
        lane, last = lane_of(traffic.y, traffic.edges)[:, :m], before.gather(1, vehicle)
        driven = traffic.driven[:, :m] & (at == tick)[:, None]
        row = _row(traffic, features, action, find_overlaps(traffic, m).any(dim=2), (lane != last) & (last >= 0))
        known.append(torch.zeros(scenes, vehicles, dtype=torch.bool).scatter(1, vehicle, driven).flatten())
        rows.append([column.new_zeros(scenes, vehicles).scatter(1, vehicle, column).flatten() for column in row])
        before = torch.full_like(before, -1).scatter(1, vehicle, torch.where(driven, lane, -1))
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    return Behaviour(scene.repeat_interleave(vehicles), torch.stack(known), *columns)


def _row(traffic: Traffic, features: Tensor, action: Tensor, contact: Tensor, changed: Tensor) -> tuple[Tensor, ...]:
    """Return the columns of `Behaviour` from `speed` on, shape (B, M) each."""
    m = action.shape[1]
    y = traffic.y[:, :m]
    ahead, rate = (features[..., columns][..., AHEAD_BEAM] for columns in (RANGE_COLUMNS, RATE_COLUMNS))
    off_road = (y < traffic.edges[:, :1]) | (y > traffic.edges[:, -1:])
    return traffic.speed[:, :m], *action.unbind(dim=-1), ahead, rate, contact, off_road, changed


Tallies = dict[str, FloatArray]
"""Sums over the vehicle-steps of each of S scenes by name, (S,) each: `steps`, those with a hard brake, in collision,
off the road and with a lane change, and of their speed; `vehicles`, and those that `ever` collide; "bins QUANTITY",
histograms (S, bins); "error NAME", squared errors after 5 s, and their number `errors`."""


def binned_quantities(behaviour: Behaviour) -> dict[str, tuple[Tensor, Tensor]]:
    """Return the values of each quantity in `BINS` with their scenes, shape (k,) each."""
    known, ahead = behaviour.known, behaviour.ahead
    scene = behaviour.scene.expand_as(known)
    jerk = (behaviour.acceleration[1:] - behaviour.acceleration[:-1]) / DT
    inverse_ttc = -behaviour.rate / ahead.clamp(min=LEAST_RANGE)
    quantities = {
        "speed": (behaviour.speed, known),
        "acceleration": (behaviour.acceleration, known),
        "jerk": (jerk, known[1:] & known[:-1]),
        "yaw_rate": (behaviour.yaw_rate, known),
        "inverse_ttc": (inverse_ttc, known & (ahead < MAX_RANGE)),
        "gap": (ahead, known),
    }
    return {name: (values[where], scene[-len(where) :][where]) for name, (values, where) in quantities.items()}


def sum_by_scene(behaviour: Behaviour, scenes: int, errors: dict[str, Tensor] | None = None) -> Tallies:
    """Return the tallies of some behaviour in S scenes, with errors after 5 s where these are known."""
    known = behaviour.known

    def by_scene(scene: Tensor, values: Tensor) -> FloatArray:
        return np.bincount(scene.numpy(), values.double().numpy(), minlength=scenes).astype(np.float64)

    def steps(values: Tensor) -> FloatArray:
        return by_scene(behaviour.scene, (values.double() * known).sum(dim=0))

    tallies = {
        "steps": steps(known),
        "hard_brake": steps(behaviour.acceleration <= HARD_BRAKE_ACCELERATION),
        "collision": steps(behaviour.contact),
        "off_road": steps(behaviour.off_road),
        "lane_changes": steps(behaviour.changed),
        "speed": steps(behaviour.speed),
        "vehicles": by_scene(behaviour.scene, known.any(dim=0)),
        "ever": by_scene(behaviour.scene, (behaviour.contact & known).any(dim=0)),
    }
    for name, (values, scene) in binned_quantities(behaviour).items():
        low, high, bins = BINS[name]
        place = ((values.double() - low) / (high - low) * bins).floor().clamp(0, bins - 1).long()
        flat = np.bincount((scene * bins + place).numpy(), minlength=scenes * bins)
        tallies[f"bins {name}"] = flat.reshape(scenes, bins).astype(np.float64)
    if errors is not None:
        tallies |= {f"error {name}": by_scene(errors["scene"], errors[name].square()) for name in ERROR_NAMES}
        tallies["errors"] = by_scene(errors["scene"], torch.ones_like(errors["position"]))
    return tallies


@dataclass(frozen=True)
class Realism:
    """Rates of a driver in recorded scenes, and its differences from people.

    Example:
        >>> shares = {"hard_brake": 0.0, "collision": 0.01, "ever": 0.05, "off_road": 0.0}
        >>> Realism(vehicles=20, **shares, lane_changes=0.1, mean_speed=14.0, divergence={}, rmse={}).collision
        0.01
    """

    vehicles: int
    hard_brake: float
    """Share of vehicle-steps at -3 m/s^2 or less."""
    collision: float
    """Share of vehicle-steps in which bodies overlap; pairs that overlap at the start are left out."""
    ever: float
    """Share of vehicles that collide at all."""
    off_road: float
    """Share of vehicle-steps with the middle of the vehicle beyond the edge."""
    lane_changes: float
    """Lane changes per vehicle and 10 s."""
    mean_speed: float
    """[m/s]."""
    divergence: dict[str, float]
    """Jensen-Shannon divergence from the record [nats], of each quantity in `BINS`."""
    rmse: dict[str, float]
    """Root mean square error against the record after 5 s: position [m], speed [m/s], lateral [m]."""


def jensen_shannon(p: FloatArray, q: FloatArray) -> float:
    """Return the Jensen-Shannon divergence of two distributions on the same bins [nats], 0 to log 2."""
    middle = 0.5 * (p + q)
    return float(0.5 * rel_entr(p, middle).sum() + 0.5 * rel_entr(q, middle).sum())


def summarise_realism(driven: Tallies, recorded: Tallies, times: FloatArray | None = None) -> Realism:
    """Return rates, divergences from a record, and errors of a driver; scenes count so many times (S,), or once."""
    times = np.ones_like(driven["steps"]) if times is None else times
    sums = {name: times @ values for name, values in driven.items()}
    per_step = {name: float(sums[name] / sums["steps"]) for name in (*SHARES, "lane_changes", "speed")}

    def divergence(name: str) -> float:
        counts = sums[f"bins {name}"], recorded[f"bins {name}"].sum(axis=0)
        return jensen_shannon(*(each / max(each.sum(), 1.0) for each in counts))

    measured = ERROR_NAMES if sums.get("errors", 0.0) > 0 else ()
    return Realism(
        vehicles=int(sums["vehicles"]),
        **{name: per_step[name] for name in SHARES},
        ever=float(sums["ever"] / sums["vehicles"]),
        lane_changes=per_step["lane_changes"] * 10.0 / DT,
        mean_speed=per_step["speed"],
        divergence={name: divergence(name) for name in BINS},
        rmse={name: float(np.sqrt(sums[f"error {name}"] / sums["errors"])) for name in measured},
    )


def collect_statistics(
    recording: Recording, act: Act, seconds: tuple[float, ...], starts: tuple[Tensor, Tensor] | None = None
) -> dict[float, Tallies]:
    """Drive recorded scenes by one driver and return the tallies up to each of some times [s], the longest last.

    Starts are scenes and ticks, (B,) each; None for every 2 s of every scene.
    """
    starts = regular_starts(recording) if starts is None else starts
    with torch.inference_mode():
        whole, errors = drive_recording(recording, act, round(seconds[-1] / DT), starts)
    out = {}
    for time in seconds:
        part = Behaviour(whole.scene, *(column[: round(time / DT)] for column in whole[1:]))
        out[time] = sum_by_scene(part, len(recording.x), errors)
    return out


def measure(
    recording: Recording, act: Act, starts: tuple[Tensor, Tensor] | None = None, seconds: float = 10.0
) -> Realism:
    """Drive scenes that a driver has not learned from for some seconds, and compare with the record.

    Starts are scenes and ticks, (B,) each; None for every 2 s of every scene.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> from training.imitation import prepare_data
        >>> recording = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0)).recording
        >>> act = lambda features, memory: (torch.zeros(*features.shape[:2], 2), None)
        >>> realism = measure(recording, act, seconds=1.0)
        >>> realism.vehicles, realism.collision
        (36, 0.0)
    """
    driven = collect_statistics(recording, act, (seconds,), starts)[seconds]
    return summarise_realism(driven, record_statistics(recording))


def record_statistics(recording: Recording) -> Tallies:
    """Return the tallies of people in the recorded scenes."""
    return sum_by_scene(recorded_behaviour(recording), len(recording.x))


def header_metrics(recording: Recording, driver: LearnedDriver, seed: int = 0) -> dict[str, dict[str, Any]]:
    """Return the metrics in the header of a driver's file: `Realism` over 10 s and 20 s, with one sequence of noise."""
    act = sampling_driver(driver, torch.Generator().manual_seed(seed))
    driven, recorded = collect_statistics(recording, act, (10.0, 20.0)), record_statistics(recording)
    return {f"{seconds:g} s": asdict(summarise_realism(one, recorded)) for seconds, one in driven.items()}
