"""Severity of collisions: P[collision with delta-v > v] over v, and the expected number of serious injuries."""

from __future__ import annotations

import math
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import samplers
from rare_envs.problem import DrivingProblem
from rare_envs.traffic.crash import NONE, OTHERS, Crash
from samplers.analysis import (
    BaseUncertainty,
    Exceedance,
    FailureExpectation,
    FurtherFailures,
    WeightedFailures,
    compute_exceedance,
    expect_over_failures,
    expect_under_refits,
    weigh_failures,
)
from samplers.method import EstimateData
from samplers.output import drawing_axes
from samplers.problem import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MAX_REPLAYED = 10_000
"""Largest number of failing points that are driven again, evenly spaced among all."""
MAX_REPLAYED_FURTHER = 2_000
"""The same of those of the run under the mixture of the refits, which count for the refits alone."""


class ReplayedFailures(NamedTuple):
    """Failing points of a run with their crashes."""

    failures: WeightedFailures
    """The points and their weights, those without an outcome included."""
    crash: Crash
    """Crashes of the points that have an outcome, in their order."""


def replay_failures(
    problem: DrivingProblem, estimate: EstimateData, most: int | None = MAX_REPLAYED
) -> ReplayedFailures:
    """Drive failing points of a run once more."""
    if problem.varies:
        raise ValueError("The ego's answers vary from run to run, so that its failures cannot be seen again.")
    failures = weigh_failures(estimate, most)
    return ReplayedFailures(failures, problem.crashes(failures.x[failures.has_outcome]))


def replay_further_failures(
    problem: DrivingProblem, estimate: EstimateData, most: int | None = MAX_REPLAYED
) -> ReplayedFailures | None:
    """Drive failing points of the further run under the mixture of the refits once more; None where there is none.

    Arguments as of `replay_failures`; at most `MAX_REPLAYED_FURTHER` are driven.
    """
    run = estimate.ensemble_run
    if run is None or run.p <= 0 or run.sample is None:
        return None
    return replay_failures(problem, run, min(MAX_REPLAYED_FURTHER, MAX_REPLAYED if most is None else most))


DELTA_V_STEP, FINE_STEP, FINE_UP_TO = 0.5, 0.1, 2.5
"""Step of the curve by default [m/s], and that of a curve that does not reach beyond 2.5 m/s."""
SHOWN_DELTA_V = (0.5, 1.0, 2.0, 5.0, 10.0, 15.0)
"""Delta-v [m/s] at which the curve is printed, the largest `SHOWN_THRESHOLDS` that are known."""
SHOWN_THRESHOLDS = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class Severity:
    """How severe the collisions among the failures of a run are.

    Of the two vehicles of a collision the larger delta-v counts. Injuries are those of one occupant in each of the two,
    MAIS 3 or more, see `rare_envs.traffic.crash.injury_risk`.

    Example:
        >>> curve = Exceedance(
        ...     thresholds=np.array([1.0, 2.0]), p=np.array([2e-3, 1e-3]), low=np.array([1e-3, 4e-4]),
        ...     high=np.array([4e-3, 2.5e-3]), cov=np.array([0.2, 0.3]), ess=np.array([25.0, 11.0]), confidence=0.95)
        >>> injuries = FailureExpectation(
        ...     value=3e-5, interval=(2e-5, 5e-5), confidence=0.95, cov=0.2, per_failure=0.015)
        >>> severity = Severity(
        ...     curve=curve, largest_delta_v=2.6, injuries=injuries, injuries_base=None,
        ...     n_replayed=500, n_failures=1200, unknown=0.0)
        >>> print(severity)
        collisions with delta-v > 1 m/s 2.0e-03 [1.0e-03, 4.0e-03], > 2 m/s 1.0e-03 [4.0e-04, 2.5e-03], at most 2.6 m/s
        serious injuries (MAIS 3+) 3.0e-05 per scenario [2.0e-05, 5.0e-05], 0.015 per failure
        from 500 of 1,200 failing scenarios, simulated again
        >>> print(severity.summarise())
        delta-v > 1 m/s 2.0e-03, > 2 m/s 1.0e-03, at most 2.6 m/s; serious injuries (MAIS 3+) 3.0e-05 per scenario
    """

    curve: Exceedance
    """P[failure in a collision with delta-v > v] over v [m/s], with a simultaneous band of the sampling, and where the
    base has refits with the band that its events allow. Where all collisions are failures, as by default, it is
    P[collision with delta-v > v]."""
    largest_delta_v: float
    """Largest delta-v among the failures that were simulated again [m/s]."""
    injuries: FailureExpectation
    """Expected serious injuries per scenario, both vehicles together."""
    injuries_base: BaseUncertainty | None
    """Interval of the same that the events behind a fitted base distribution allow; None where it has no refits."""
    n_replayed: int
    """Failing scenarios that were simulated again for it; not in the run's n_sim."""
    n_failures: int
    """Failing scenarios that the run has."""
    unknown: float
    """Share of p from scenarios on which the ego failed: they have no delta-v and are left out."""

    def __str__(self) -> str:
        """Return a few lines for people."""
        curve, shown = self.curve, self._shown_thresholds
        parts = [
            f"> {curve.thresholds[i]:g} m/s {curve.p[i]:.1e} [{curve.low[i]:.1e}, {curve.high[i]:.1e}]" for i in shown
        ]
        low, high = self.injuries.interval
        lines = [
            f"collisions with delta-v {', '.join([*parts, f'at most {self.largest_delta_v:.2g} m/s'])}",
            *self._describe_base(shown),
            f"serious injuries (MAIS 3+) {self.injuries.value:.1e} per scenario [{low:.1e}, {high:.1e}], "
            f"{self.injuries.per_failure:.2g} per failure",
            *("" if self.injuries_base is None else f"  {self.injuries_base}").splitlines()[:1],
            f"from {self.n_replayed:,} of {self.n_failures:,} failing scenarios, simulated again",
        ]
        if self.unknown:
            lines[-1] += f"; {100 * self.unknown:.2g} % of p have no outcome and are left out"
        return "\n".join(lines)

    def summarise(self) -> str:
        """Return a short line for people, without intervals."""
        parts = [f"> {self.curve.thresholds[i]:g} m/s {self.curve.p[i]:.1e}" for i in self._shown_thresholds]
        speeds = ", ".join([*parts, f"at most {self.largest_delta_v:.2g} m/s"])
        return f"delta-v {speeds}; serious injuries (MAIS 3+) {self.injuries.value:.1e} per scenario"

    @property
    def _shown_thresholds(self) -> list[int]:
        """Indices of the thresholds that are printed."""
        known = [i for i, v in enumerate(self.curve.thresholds) if v in SHOWN_DELTA_V and self.curve.low[i] > 0]
        return known[-SHOWN_THRESHOLDS:]

    def _describe_base(self, shown: list[int]) -> list[str]:
        """Return what the events behind the base allow for the curve, in words."""
        base = self.curve.base
        if base is None or not shown:
            return []
        parts = [
            f"> {self.curve.thresholds[i]:g} m/s {format_ends(float(base.low[i]), float(base.high[i]))}" for i in shown
        ]
        behind = f"({base.fitted_to}, {base.n_refits} refits)"
        held = f"{100 * base.confidence:g} % of all thresholds together"
        return [f"  base distribution {held}  {', '.join(parts)} {behind}"]

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for JSON."""
        curve = self.curve.to_dict()
        return {
            "curve": {"delta_v": curve.pop("thresholds"), **curve},
            "largest_delta_v": self.largest_delta_v,
            "injuries": self.injuries.to_dict(),
            "injuries_base": None if self.injuries_base is None else self.injuries_base.to_dict(),
            "n_replayed": self.n_replayed,
            "n_failures": self.n_failures,
            "unknown": self.unknown,
        }

    def plot(self, ax: Axes | str | PathLike[str] | None = None) -> Axes:
        """Draw P[collision with delta-v > v] over v with the bands of sampling and base distribution.

        Needs matplotlib.
        """
        with drawing_axes(ax) as axes:
            self.curve.plot(axes)
            axes.set_xlabel("delta-v [m/s]")
            axes.set_ylabel("P[collision with a larger delta-v]")
        return axes


def severity_curve(
    problem: DrivingProblem,
    estimate: samplers.Estimate,
    thresholds: ArrayLike | None = None,
    most: int | None = MAX_REPLAYED,
) -> Severity:
    """Return the severity of the collisions behind an estimate; its failing points are simulated once more.

    Args:
        problem: The problem that was estimated.
        estimate: Its estimate.
        thresholds: Delta-v [m/s] at which the curve is wanted; every 0.5 m/s up to the largest by default,
            or every 0.1 m/s if that is at most 2.5 m/s.
        most: Drive at most so many failing points again, evenly spaced among all; None for all.

    Raises:
        ValueError: If no failure is a collision, the method gave no weighted points, nothing failed, or the ego's
            answers vary from run to run.

    Example:
        >>> import rare_envs, samplers
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", base="us101-gap")
        >>> severity = severity_curve(problem, samplers.estimate(problem, seed=0, max_sim=2000), thresholds=[0.0, 2.5])
        >>> bool(severity.curve.p[0] > severity.curve.p[1]), 0.0005 < severity.injuries.per_failure < 0.1
        (True, True)
    """
    replayed, further = replay_failures(problem, estimate, most), replay_further_failures(problem, estimate, most)
    severity = compute_severity(problem, estimate, replayed, thresholds, further)
    if severity is None:
        raise ValueError(f"No failure (f <= {estimate.gamma:g}) that was driven again is a collision.")
    return severity


def compute_severity(
    problem: DrivingProblem,
    estimate: samplers.Estimate,
    replayed: ReplayedFailures,
    thresholds: ArrayLike | None = None,
    further: ReplayedFailures | None = None,
) -> Severity | None:
    """Return the severity of failures that were driven again; None where none of them is a collision.

    Arguments as of `severity_curve`; and `further`, failures of the run under the mixture of the refits, if there is
    one: they tell the severity under refits that the failures of the first run do not reach.
    """
    failures, any_vehicle = replayed.failures, problem.world.measurement.collisions == "any"
    delta_v, injuries = _severities(replayed, any_vehicle)
    more_delta_v, more_injuries = _further_severities(further, any_vehicle)
    collided = np.isfinite(delta_v)
    if not collided.any():
        return None
    if thresholds is None:
        largest = float(delta_v[collided].max())
        step = DELTA_V_STEP if largest > FINE_UP_TO else FINE_STEP
        thresholds = step * np.arange(math.ceil(largest / step) or 1)
    expected = expect_over_failures(failures, injuries, estimate.confidence)
    return Severity(
        curve=compute_exceedance(estimate, failures, delta_v, thresholds, more_delta_v),
        largest_delta_v=float(delta_v[collided].max()),
        injuries=expected,
        injuries_base=expect_under_refits(estimate, failures, injuries, expected, more_injuries),
        n_replayed=int(failures.has_outcome.sum()),
        n_failures=failures.total,
        unknown=float(failures.weights[~failures.has_outcome].sum() / failures.weights.sum()),
    )


def _further_severities(
    further: ReplayedFailures | None, any_vehicle: bool
) -> tuple[FurtherFailures | None, FurtherFailures | None]:
    """Return delta-v and injuries at the failing points of the further run; None where there is none."""
    if further is None:
        return None, None
    delta_v, injuries = _severities(further, any_vehicle)
    return FurtherFailures(further.failures, delta_v), FurtherFailures(further.failures, injuries)


def format_ends(low: float, high: float) -> str:
    """Return an interval of a probability, or what it is below."""
    if low > 0:
        return f"{low:.1e} to {high:.1e}"
    return f"below {high:.1e}" if high < 1 else "not bounded"


def _severities(replayed: ReplayedFailures, any_vehicle: bool) -> tuple[FloatArray, FloatArray]:
    """Return delta-v [m/s] (-inf without a collision) and expected injuries of each failing point, shape (k,) each."""
    crash, known = replayed.crash, replayed.failures.has_outcome
    kind = crash.kind.numpy()
    counts = (kind != NONE) & (any_vehicle | (kind != OTHERS))
    delta_v, injuries = np.full(len(known), -np.inf), np.zeros(len(known))
    delta_v[known] = np.where(counts, crash.delta_v.double().amax(dim=1).numpy(), -np.inf)
    injuries[known] = np.where(counts, crash.injury_risk.double().sum(dim=1).numpy(), 0.0)
    return delta_v, injuries
