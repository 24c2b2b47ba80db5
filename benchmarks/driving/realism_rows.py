"""Rows of the report on realism: measurements of people, drivers, drawn weights, search boxes and other starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents import LearnedDriver
from agents.learned.networks import ACTION_SIZE, HIDDEN_SIZES
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH
from training.data.ngsim_tables import US101_EDGES
from training.imitation.evaluation.behaviour import Act, behaviour_of, drive_traffic, sampling_driver
from training.imitation.evaluation.driving_statistics import BINS, DrivingStatistics, add_statistics, sum_by_scene
from training.imitation.evaluation.prediction_error import Errors, draw_segments, prediction_errors
from training.imitation.evaluation.realism import (
    bootstrap_errors,
    collect_statistics,
    record_statistics,
    summarise_realism,
)
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import Traffic

SECONDS = (10.0, 20.0)
RADII = (0.003, 0.01, 0.03, 0.1)
"""Half-widths of search boxes around the mean of the weights."""
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Effort:
    """Amount of simulation."""

    noises: int = 3
    """Sequences of noise of each driver."""
    draws: int = 6
    """Policies drawn from a distribution of weights, and from the inside and the corners of a box."""
    rollouts: int = 20
    """Rollouts of each segment in which one vehicle is driven among replayed others."""
    each: int = 4
    """Number of such vehicles every 2 s of a scene."""
    highway: int = 200
    """Number of starts at O'Kelly et al.'s speeds."""


@dataclass(frozen=True)
class Judge:
    """Comparison of drivers with people."""

    test: Recording
    recorded: DrivingStatistics
    """Statistics of the people in the test scenes."""
    effort: Effort

    def row(self, name: str, kind: str, acts: Sequence[Act], seconds: Sequence[float] | None = None) -> dict[str, Any]:
        """Return the realism of one driver over some times.

        Args:
            name: Name of the row.
            kind: Kind of the row: "reference", "driver", "distribution" or "box".
            acts: One driver for each sequence of noise, or for each policy.
            seconds: Times [s], the longest last; None for `SECONDS`.
        """
        seconds = SECONDS if seconds is None else seconds
        runs = [collect_statistics(self.test, act, tuple(seconds)) for act in acts]
        return {"name": name, "kind": kind, **self.figures({time: [run[time] for run in runs] for time in seconds})}

    def figures(self, runs: dict[float, list[DrivingStatistics]]) -> dict[str, Any]:
        """Return values and standard errors of several runs together, and the collision rate of each."""
        out: dict[str, Any] = {}
        for seconds, parts in runs.items():
            whole = add_statistics(parts)
            out[f"{seconds:g} s"] = {
                **asdict(summarise_realism(whole, self.recorded)),
                "standard_error": asdict(bootstrap_errors(whole, self.recorded, np.random.default_rng(0))),
                "collisions": [summarise_realism(part, self.recorded).collision for part in parts],
            }
        whole = add_statistics(runs[SECONDS[0]])
        out["shares"] = {
            name: (whole.counts[name].sum(0) / max(whole.counts[name].sum(), 1.0)).tolist() for name in BINS
        }
        return out


def noisy_drivers(driver: LearnedDriver, number: int, weights: Tensor | None = None) -> list[Act]:
    """Return a driver with several sequences of noise."""
    return [sampling_driver(driver, torch.Generator().manual_seed(seed), weights) for seed in range(number)]


def measure_people(train: Recording, judge: Judge) -> dict[str, Any]:
    """Return the record's own rates, and divergences between its training and its test scenes."""
    learned = record_statistics(train)
    row = {"name": "people", "kind": "reference", **judge.figures({time: [judge.recorded] for time in SECONDS})}
    for seconds in SECONDS:
        row[f"{seconds:g} s"]["divergence"] = summarise_realism(learned, judge.recorded).divergence
        row[f"{seconds:g} s"]["hard_brake_in_training_scenes"] = summarise_realism(learned, judge.recorded).hard_brake
    return row


def measure_drawn(name: str, driver: LearnedDriver, judge: Judge) -> dict[str, Any]:
    """Return the realism of policies drawn from the distribution of a driver's weights, one sequence of noise each."""
    assert driver.weights is not None
    weights = torch.from_numpy(driver.weights.sample(judge.effort.draws, np.random.default_rng(0))).float()
    acts = [noisy_drivers(driver, 1, row)[0] for row in weights]
    return judge.row(f"{name}, drawn from its distribution", "distribution", acts)


def move_weights(driver: LearnedDriver, features: Tensor, draws: int) -> Iterator[tuple[float, str, list[Tensor]]]:
    """Yield weights moved within boxes around their mean: radius, direction, and the moved weights (404,).

    A direction is "uniform" or "corner" (random ones), or names an output and a sign: all weights of that output are
    moved with the signs of its mean inputs, which shifts it the furthest.
    """
    assert driver.weights is not None
    mean = torch.from_numpy(np.array(driver.weights.mean)).float()
    with torch.no_grad():
        hidden = driver.policy.trunk(features).mean(dim=0)
    signs = torch.cat((hidden.sign(), torch.ones(1)))
    generator = torch.Generator().manual_seed(0)
    for radius in RADII:
        inside = 2.0 * torch.rand(draws, len(mean), generator=generator) - 1.0
        yield radius, "uniform", list(mean + radius * inside)
        yield radius, "corner", list(mean + radius * inside.sign())
        for output, name in enumerate(("acceleration", "yaw rate", "spread of acceleration", "spread of yaw rate")):
            for sign in (1.0, -1.0):
                direction = torch.zeros(2 * ACTION_SIZE, HIDDEN_SIZES[-1] + 1)
                direction[output] = sign * signs
                yield radius, f"{name} {'+' if sign > 0 else '-'}", [mean + radius * direction.flatten()]


def measure_boxes(name: str, driver: LearnedDriver, features: Tensor, judge: Judge) -> Rows:
    """Return the realism over 10 s of policies within search boxes."""
    rows = []
    for radius, direction, weights in move_weights(driver, features, max(judge.effort.draws // 2, 1)):
        acts = [noisy_drivers(driver, 1, row)[0] for row in weights]
        row = judge.row(f"{name}, box {radius:g}, {direction}", "box", acts, SECONDS[:1])
        del row["shares"]
        rows.append({**row, "driver": name, "radius": radius, "direction": direction})
    return rows


def measure_errors(
    test: Recording, act: Act, effort: Effort, rollouts: int | None = None
) -> dict[str, dict[str, float]]:
    """Return root mean square errors with one vehicle driven and the others replayed, by seconds."""
    chosen = draw_segments(test, 2.0, effort.each, torch.Generator().manual_seed(0))
    found = prediction_errors(test, act, chosen, effort.rollouts if rollouts is None else rollouts)
    return {f"{seconds:g}": _rmse(errors, len(test.x)) for seconds, errors in found.items() if len(errors.scene)}


def _rmse(errors: Errors, scenes: int, draws: int = 200) -> dict[str, float]:
    """Return root mean squares and their standard errors, by bootstrap over scenes."""
    times = np.random.default_rng(0).multinomial(scenes, [1 / scenes] * scenes, draws)
    number = np.bincount(errors.scene.numpy(), minlength=scenes)
    out = {"vehicles": float(len(errors.scene))}
    for name in ("position", "speed", "lateral"):
        squared = getattr(errors, name).double().square().numpy()
        sums = np.bincount(errors.scene.numpy(), squared, minlength=scenes)
        out[name] = float(np.sqrt(squared.mean()))
        out[f"{name}_standard_error"] = float(
            np.nanstd(np.sqrt((times @ sums) / np.maximum(times @ number, 1)), ddof=1)
        )
    return out


def highway_starts(number: int) -> Traffic:
    """Return O'Kelly et al.'s starts on the lanes of US 101: six cars within 40 m, one per lane, 10 to 20 m/s."""
    rng = np.random.default_rng(0)
    along, across, heading, speed = (torch.from_numpy(rng.beta(2, 2, (number, 6))).float() for _ in range(4))
    edges = torch.tensor(US101_EDGES)
    every = torch.ones(number, 6, dtype=torch.bool)
    return Traffic(
        x=40.0 * along,
        y=0.5 * (edges[1:] + edges[:-1]) + 0.5 * across - 0.25,
        heading=torch.deg2rad(7.2 * heading - 3.6),
        speed=10.0 * speed + 10.0,
        length=torch.full((number, 6), VEHICLE_LENGTH),
        width=torch.full((number, 6), VEHICLE_WIDTH),
        edges=edges.expand(number, -1),
        scene=torch.arange(number),
        tick=torch.zeros(number, dtype=torch.long),
        vehicle=torch.arange(6).expand(number, -1),
        there=every,
        driven=every,
    )


def measure_on_highway(name: str, act: Act, judge: Judge) -> dict[str, Any]:
    """Return the behaviour from O'Kelly et al.'s starts; divergences are from the people of US 101."""
    start = highway_starts(judge.effort.highway)
    with torch.inference_mode():
        whole = behaviour_of(drive_traffic(None, start, act, round(SECONDS[-1] / 0.1)))
    runs = {}
    for seconds in SECONDS:
        part = type(whole)(whole.scene, *(column[: round(seconds / 0.1)] for column in whole[1:]))
        runs[seconds] = [sum_by_scene(part, judge.effort.highway)]
    last = whole.speed[-1].double()
    figures = judge.figures(runs)
    del figures["shares"]
    return {"name": name, **figures, "last_speed": float(last.mean()), "slowest": float(last.min())}
