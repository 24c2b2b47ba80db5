"""Realism of a driver: all vehicles of recorded scenes are driven by it and compared with the record.

Rates are per vehicle-step, as in RAIL; `ever` counts vehicles. Divergences are Jensen-Shannon, in nats, over fixed
bins that fit smoothed data; Kuefler et al.'s bins are far wider.

References:
    Kuefler, Morton, Wheeler and Kochenderfer, "Imitating driver behavior with generative adversarial networks",
    2017. Bhattacharyya et al., "Simulating emergent properties of human driving behavior using multi-agent reward
    augmented imitation learning", 2019.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents import LearnedDriver
from samplers.problem import FloatArray
from training.data.trajectories import DT
from training.imitation.evaluation.behaviour import (
    Act,
    Behaviour,
    DrivingStep,
    behaviour_of,
    drive_traffic,
    recorded_behaviour,
    regular_starts,
    sampling_driver,
)
from training.imitation.evaluation.driving_statistics import BINS, ERROR_NAMES, DrivingStatistics, sum_by_scene
from training.imitation.evaluation.prediction_error import Errors, current_errors
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import start_replay

_SHARES = ("hard_brake", "collision", "off_road")
ERROR_TIME = 5.0
"""Time [s] after which positions are compared with the record, all vehicles driven."""


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
    """Return the Jensen-Shannon divergence of two distributions on the same bins [nats], 0 to log 2.

    Example:
        >>> round(jensen_shannon(np.array([1.0, 0.0]), np.array([0.0, 1.0])), 4)
        0.6931
    """
    middle = 0.5 * (p + q)

    def kl(a: FloatArray) -> float:
        inside = a > 0
        return float((a[inside] * np.log(a[inside] / middle[inside])).sum())

    return 0.5 * kl(p) + 0.5 * kl(q)


def summarise_realism(
    driven: DrivingStatistics, recorded: DrivingStatistics, times: FloatArray | None = None
) -> Realism:
    """Return rates, divergences and errors from the statistics of a driver.

    Args:
        driven: Statistics of the driver.
        recorded: Statistics of the record that it is compared with.
        times: Number of times that each scene counts, shape (S,); None for once.
    """
    times = np.ones_like(driven.steps) if times is None else times
    steps, vehicles = times @ driven.steps, times @ driven.vehicles

    def share(counts: FloatArray, of: FloatArray) -> FloatArray:
        total = of @ counts
        return np.asarray(total / max(total.sum(), 1.0))

    ones = np.ones_like(recorded.steps)
    shares = {name: float(times @ driven.sums[name] / steps) for name in _SHARES}
    rmse = {}
    if driven.squared and (number := times @ driven.squared["number"]) > 0:
        rmse = {name: float(np.sqrt(times @ driven.squared[name] / number)) for name in ERROR_NAMES}
    return Realism(
        vehicles=int(vehicles),
        **shares,
        ever=float(times @ driven.sums["ever"] / vehicles),
        lane_changes=float(times @ driven.sums["lane_changes"] / steps * 10.0 / DT),
        mean_speed=float(times @ driven.sums["speed"] / steps),
        divergence={
            name: jensen_shannon(share(driven.counts[name], times), share(recorded.counts[name], ones)) for name in BINS
        },
        rmse=rmse,
    )


def collect_statistics(
    recording: Recording, act: Act, seconds: tuple[float, ...], starts: tuple[Tensor, Tensor] | None = None
) -> dict[float, DrivingStatistics]:
    """Drive recorded scenes and return the statistics up to each of some times.

    Args:
        recording: Scenes that the driver has not learned from.
        act: Driver of all vehicles.
        seconds: Times [s], the longest last.
        starts: Scenes and ticks to start from; None for every 2 s of every scene.
    """
    met: list[Errors] = []

    def watch() -> Iterator[DrivingStep]:
        traffic = start_replay(recording, *(regular_starts(recording) if starts is None else starts))
        for tick, moment in enumerate(drive_traffic(recording, traffic, act, round(seconds[-1] / DT))):
            if tick == round(ERROR_TIME / DT):
                met.append(current_errors(recording, moment.traffic))
            yield moment

    whole = behaviour_of(watch())
    out = {}
    for time in seconds:
        part = Behaviour(whole.scene, *(column[: round(time / DT)] for column in whole[1:]))
        out[time] = sum_by_scene(part, len(recording.x), met[0] if met else None)
    return out


def measure(
    recording: Recording, act: Act, starts: tuple[Tensor, Tensor] | None = None, seconds: float = 10.0
) -> Realism:
    """Drive recorded scenes and compare with the record.

    Args:
        recording: Scenes that the driver has not learned from.
        act: Driver of all vehicles.
        starts: Scenes and ticks to start from; None for every 2 s of every scene.
        seconds: Time for which each start is driven [s].

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> from training.imitation import prepare_data
        >>> recording = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0)).recording
        >>> act = lambda features, memory: (torch.zeros(*features.shape[:2], 2), None)
        >>> realism = measure(recording, act, seconds=1.0)
        >>> realism.vehicles, realism.collision
        (36, 0.0)
    """
    return summarise_realism(
        collect_statistics(recording, act, (seconds,), starts)[seconds], record_statistics(recording)
    )


def record_statistics(recording: Recording) -> DrivingStatistics:
    """Return the statistics of people in the recorded scenes."""
    return sum_by_scene(recorded_behaviour(recording), len(recording.x))


def bootstrap_errors(
    driven: DrivingStatistics, recorded: DrivingStatistics, rng: np.random.Generator, draws: int = 200
) -> Realism:
    """Return standard errors by bootstrap over scenes; scenes that share vehicles are taken as independent."""
    scenes = len(driven.steps)
    drawn = [
        asdict(summarise_realism(driven, recorded, times))
        for times in rng.multinomial(scenes, [1 / scenes] * scenes, draws)
    ]

    def spread(values: list[Any]) -> Any:
        if isinstance(values[0], dict):
            return {key: spread([value[key] for value in values]) for key in values[0]}
        return float(np.std(values, ddof=1))

    return Realism(**{name: spread([one[name] for one in drawn]) for name in drawn[0]})


def header_metrics(recording: Recording, driver: LearnedDriver, seed: int = 0) -> dict[str, dict[str, Any]]:
    """Return the metrics in the header of a driver's file: `Realism` over 10 s and 20 s, with one sequence of noise."""
    statistics = collect_statistics(
        recording, sampling_driver(driver, torch.Generator().manual_seed(seed)), (10.0, 20.0)
    )
    recorded = record_statistics(recording)
    return {f"{seconds:g} s": asdict(summarise_realism(one, recorded)) for seconds, one in statistics.items()}
