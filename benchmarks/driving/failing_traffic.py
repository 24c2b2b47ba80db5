"""Failing traffic: its distribution compared with the base distribution, and the behaviour of its drivers."""

from typing import Any

import numpy as np
import torch

import rare_envs
import samplers
from rare_envs.simulation.rollout import drive
from samplers.problem import FloatArray


def failing_points(results: list[samplers.Estimate]) -> tuple[FloatArray, FloatArray]:
    """Return points with f <= gamma of several runs, shape (k, d), and their weights, which add up to 1."""
    points, weights = [], []
    for result in results:
        if result.sample is not None and len(result.sample.x):
            points.append(result.sample.x)
            weights.append(result.sample.weights[result.sample.f <= result.gamma])
    every = np.concatenate(weights)
    return np.concatenate(points), every / every.sum()


def describe_failures(
    problem: rare_envs.DrivingProblem, x: FloatArray, weights: FloatArray, rng: np.random.Generator
) -> dict[str, Any]:
    """Compare the distribution of the scenario parameters given failure with the base distribution.

    Returns:
        Speeds of the vehicles that start behind the ego and ahead of it, their distance from it along the road, and
        the variance of every parameter, each as ratio or difference between failures and base.
    """
    base = problem.base.sample(5000, rng)
    out: dict[str, Any] = {"points": len(x)}
    failing, usual = (problem.space.columns(each) for each in (x, base))
    even = np.full(len(base), 1 / len(base))
    for name in ("s", "t", "heading", "speed"):
        ratio = weighted_variance(failing[name][:, 1:], weights) / weighted_variance(usual[name][:, 1:], even)
        out[f"variance_ratio_{name}"] = float(ratio.mean())
    for kind, columns, w in (("failures", failing, weights), ("base", usual, even)):
        behind = columns["s"][:, 1:] < columns["s"][:, :1]
        speed, gap = columns["speed"][:, 1:], np.abs(columns["s"][:, 1:] - columns["s"][:, :1])
        out[f"speed_behind_{kind}"] = weighted_mean(speed, behind, w)
        out[f"speed_ahead_{kind}"] = weighted_mean(speed, ~behind, w)
        out[f"distance_next_lanes_{kind}"] = float(w @ gap[:, [1, 2]].mean(axis=1))
        out[f"ego_speed_{kind}"] = float(w @ columns["speed"][:, 0])
    shift = weights @ failing["weights"] - usual["weights"].mean(axis=0)
    out["largest_shift_of_a_weight"] = float(np.abs(shift).max())
    return out


def weighted_variance(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the weighted variance of each column."""
    mean = weights @ values
    return np.asarray(weights @ (values - mean) ** 2)


def weighted_mean(values: FloatArray, chosen: Any, weights: FloatArray) -> float:
    """Return the weighted mean of the chosen entries of (n, k)."""
    w = weights[:, None] * chosen
    return float((w * values).sum() / w.sum())


def measure_drivers(problem: rare_envs.DrivingProblem, x: FloatArray) -> dict[str, float]:
    """Return hard brakes per vehicle-step, lane changes per vehicle and 10 s, and mean speed of the five drivers."""
    hard, changes, speeds, lanes, before = [], [], [], None, None
    road = problem.world.scenario.road
    with torch.inference_mode():
        for episode in drive(problem.world, problem.driver, torch.from_numpy(x).float()):
            speed = episode.state.speed[:, 1:]
            lane = road.lane_of(episode.state.y[:, 1:])
            if before is not None and lanes is not None:
                hard.append(((speed - before) / problem.world.clock.dt <= -3.0).float().mean())
                changes.append((lane != lanes).float().mean())
            before, lanes = speed, lane
            speeds.append(speed.mean())
    return {
        "hard_brake": float(torch.stack(hard).mean()),
        "lane_changes": float(torch.stack(changes).sum()) * 10.0 / problem.world.clock.seconds,
        "speed": float(torch.stack(speeds).mean()),
    }
