"""Severity of collisions against crash speeds by pencil and paper, Monte Carlo and the parts of p."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import rare_envs
import samplers
from rare_envs.control.idm import IDM
from rare_envs.distributions import EventCounts, FittedDistribution
from rare_envs.study import severity_curve
from rare_envs.study.failures import compute_severity, replay_failures
from rare_envs.traffic.crash import injury_risk

FOLLOWING, CUT_IN = "rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0"


def estimate_of(x: np.ndarray, gamma: float = 0.0) -> samplers.Estimate:
    """Return an estimate of plain draws of which these x are all that failed, 1 in 10."""
    f = np.concatenate([np.full(len(x), -1.0), np.full(9 * len(x), 5.0)])
    problem = samplers.FunctionProblem(lambda u: np.ones(len(u)), 3)
    run = samplers.estimate(problem, "mc", max_sim=100, seed=0)
    return replace(run, p=0.1, cov=(9 / len(f)) ** 0.5, sample=samplers.Sample.of_equal_draws(f, x))


def test_a_coasting_ego_hits_at_half_the_closing_speed() -> None:
    """An ego that only coasts runs into its lead at the closing speed that it began with; delta-v is half of that."""
    problem = rare_envs.DrivingProblem(FOLLOWING, ego=IDM(max_deceleration=1e-3, max_acceleration=1e-3))
    closing = np.array([4.0] * 10 + [12.0] * 10)
    x = np.stack([20.0 + 0 * closing, 20.0 - closing, 10.0 + 0 * closing], axis=1)
    severity = severity_curve(problem, estimate_of(x), thresholds=[0.0, 1.9, 2.1, 5.9, 6.1])
    assert severity.curve.p.tolist() == pytest.approx([0.1, 0.1, 0.05, 0.05, 0.0])
    one, six = (
        sum(injury_risk(torch.tensor(v, dtype=torch.float64), mode).item() for mode in ("frontal", "rear"))
        for v in (2.0, 6.0)
    )
    assert severity.largest_delta_v == pytest.approx(6.0, rel=0.01)
    assert severity.injuries.per_failure == pytest.approx((one + six) / 2, rel=0.01)
    assert severity.injuries.value == pytest.approx(0.1 * (one + six) / 2, rel=0.01)


def test_collisions_of_others_count_only_if_asked_for() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=IDM(max_deceleration=1.0))
    estimate = samplers.estimate(problem, "mc", max_sim=2000, gamma=0.5, seed=0)
    replayed, _ = replay_failures(problem, estimate)
    kind = replayed.crash.kind.clone()
    first = int((kind != 0).nonzero()[0])
    kind[first] = 5  # as if it had been one between others
    changed = replayed._replace(crash=replayed.crash._replace(kind=kind))
    every = rare_envs.DrivingProblem(CUT_IN, ego=IDM(max_deceleration=1.0), collisions="any")
    own, any_vehicle = (compute_severity(each, estimate, changed, thresholds=[-1.0]) for each in (problem, every))
    assert any_vehicle.curve.p[0] - own.curve.p[0] == pytest.approx(1 / 2000)


def moved_base(sd: float, number: int = 20) -> FittedDistribution:
    """Return the car-following base with plain gaps and refits whose means are moved by as many standard errors."""
    plain_base = rare_envs.DrivingProblem(FOLLOWING, base="us101-gap").base.distribution  # type: ignore[attr-defined]
    parameters = plain_base.parameters()  # type: ignore[attr-defined]
    means = [each.name.startswith("mean") for each in parameters]
    rng = np.random.default_rng(0)
    values, changes = (np.array([getattr(each, name) for each in parameters]) for name in ("value", "change"))
    refits = tuple(
        plain_base.with_parameters(values + sd * rng.standard_normal(len(values)) * changes * means)  # type: ignore[attr-defined]
        for _ in range(number)
    )
    events = EventCounts(used=(40,), clusters=12)
    return FittedDistribution(distribution=plain_base, refits=refits, events=events, family="3 components")


def test_curve_and_injuries_have_the_intervals_of_a_fitted_base() -> None:
    """Moved by refits as p is: wider than those of the sampling, printed and saved."""
    problem = rare_envs.DrivingProblem(FOLLOWING, base=moved_base(0.1))
    estimate = samplers.estimate(problem, seed=0, max_sim=2500)
    severity = severity_curve(problem, estimate, thresholds=[-1.0, 1.0])
    wide = severity.injuries_base
    assert wide.p == severity.injuries.value
    assert wide.interval[0] < severity.injuries.interval[0] < severity.injuries.interval[1] < wide.interval[1]
    curve, band = severity.curve, severity.curve.base
    assert (band.low < curve.low).all() and (curve.high < band.high).all()
    whole = estimate.base_uncertainty
    alone = severity_curve(problem, estimate, thresholds=[-1.0]).curve.base  # every failure is a collision
    assert (alone.low[0], alone.high[0]) == pytest.approx(whole.interval, rel=0.02)
    assert band.low[0] < alone.low[0] < alone.high[0] < band.high[0]
    text = str(severity)
    ends = f"> 1 m/s {band.low[1]:.1e} to {band.high[1]:.1e} (40 events of 12 scenes, 20 refits)"
    assert f"base distribution 95 % of all thresholds together  {ends}" in text
    assert text.count("base distribution 95 %") == 2
    saved = json.loads(json.dumps(severity.to_dict(), allow_nan=False))
    assert saved["injuries_base"]["spread"] == wide.spread
    assert saved["curve"]["base"]["low"] == band.low.tolist()
