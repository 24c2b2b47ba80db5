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
) -> tuple[ReplayedFailures, ReplayedFailures | None]:
    """Drive failing points of a run once more, and those of its run under the mixture of the refits, if it has one."""
    if problem.varies:
        raise ValueError("The ego's answers vary from run to run, so that its failures cannot be seen again.")

    def replay(run: EstimateData, most: int | None) -> ReplayedFailures:
        failures = weigh_failures(run, most)
        return ReplayedFailures(failures, problem.crashes(failures.x[failures.has_outcome]))

    own, further = replay(estimate, most), estimate.ensemble_run
    if further is None or further.p <= 0 or further.sample is None:
        return own, None
    return own, replay(further, min(MAX_REPLAYED_FURTHER, MAX_REPLAYED if most is None else most))


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
        curve, shown, (low, high) = self.curve, self._shown_thresholds, self.injuries.interval
        ends = [f" [{curve.low[i]:.1e}, {curve.high[i]:.1e}]" for i in shown]
        lines = [f"collisions with delta-v {self._list_speeds(ends)}"]
        if curve.base is not None and shown:
            base = curve.base
            held = f"{100 * base.confidence:g} % of all thresholds together"
            parts = [f"> {curve.thresholds[i]:g} m/s {_format_ends(base.low[i], base.high[i])}" for i in shown]
            lines.append(f"  base distribution {held}  {', '.join(parts)} ({base.fitted_to}, {base.n_refits} refits)")
        lines.append(
            f"serious injuries (MAIS 3+) {self.injuries.value:.1e} per scenario [{low:.1e}, {high:.1e}], "
            f"{self.injuries.per_failure:.2g} per failure"
        )
        if self.injuries_base is not None:
            lines.append(f"  {self.injuries_base}".splitlines()[0])
        lines.append(f"from {self.n_replayed:,} of {self.n_failures:,} failing scenarios, simulated again")
        if self.unknown:
            lines[-1] += f"; {100 * self.unknown:.2g} % of p have no outcome and are left out"
        return "\n".join(lines)

    def summarise(self) -> str:
        """Return a short line for people, without intervals."""
        speeds = self._list_speeds([""] * len(self._shown_thresholds))
        return f"delta-v {speeds}; serious injuries (MAIS 3+) {self.injuries.value:.1e} per scenario"

    @property
    def _shown_thresholds(self) -> list[int]:
        """Indices of the thresholds that are printed."""
        known = [i for i, v in enumerate(self.curve.thresholds) if v in SHOWN_DELTA_V and self.curve.low[i] > 0]
        return known[-SHOWN_THRESHOLDS:]

    def _list_speeds(self, ends: list[str]) -> str:
        """Return the curve at the thresholds that are printed, each with what stands behind it, and the largest."""
        curve, shown = self.curve, zip(self._shown_thresholds, ends, strict=True)
        parts = [f"> {curve.thresholds[i]:g} m/s {curve.p[i]:.1e}{end}" for i, end in shown]
        return ", ".join([*parts, f"at most {self.largest_delta_v:.2g} m/s"])

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
    severity = compute_severity(problem, estimate, *replay_failures(problem, estimate, most), thresholds)
    if severity is None:
        raise ValueError(f"No failure (f <= {estimate.gamma:g}) that was driven again is a collision.")
    return severity


def compute_severity(
    problem: DrivingProblem,
    estimate: samplers.Estimate,
    replayed: ReplayedFailures,
    further: ReplayedFailures | None = None,
    thresholds: ArrayLike | None = None,
) -> Severity | None:
    """Return the severity of failures that were driven again; None where none of them is a collision.

    `further` are failures of the run under the mixture of the refits, if there is one: they tell the severity under
    refits that the failures of the first run do not reach.
    """
    failures, any_vehicle = replayed.failures, problem.world.measurement.collisions == "any"
    delta_v, injuries = _severities(replayed, any_vehicle)
    more: list[FurtherFailures | None] = [None, None]
    if further is not None:
        more = [FurtherFailures(further.failures, values) for values in _severities(further, any_vehicle)]
    collided = np.isfinite(delta_v)
    if not collided.any():
        return None
    largest = float(delta_v[collided].max())
    if thresholds is None:
        step = DELTA_V_STEP if largest > FINE_UP_TO else FINE_STEP
        thresholds = step * np.arange(math.ceil(largest / step) or 1)
    expected = expect_over_failures(failures, injuries, estimate.confidence)
    return Severity(
        curve=compute_exceedance(estimate, failures, delta_v, thresholds, more[0]),
        largest_delta_v=largest,
        injuries=expected,
        injuries_base=expect_under_refits(estimate, failures, injuries, expected, more[1]),
        n_replayed=int(failures.has_outcome.sum()),
        n_failures=failures.total,
        unknown=float(failures.weights[~failures.has_outcome].sum() / failures.weights.sum()),
    )


def _severities(replayed: ReplayedFailures, any_vehicle: bool) -> tuple[FloatArray, FloatArray]:
    """Return delta-v [m/s] (-inf without a collision) and expected injuries of each failing point, shape (k,) each."""
    crash, known = replayed.crash, replayed.failures.has_outcome
    kind = crash.kind.numpy()
    counts = (kind != NONE) & (any_vehicle | (kind != OTHERS))
    delta_v, injuries = np.full(len(known), -np.inf), np.zeros(len(known))
    delta_v[known] = np.where(counts, crash.delta_v.double().amax(dim=1).numpy(), -np.inf)
    injuries[known] = np.where(counts, crash.injury_risk.double().sum(dim=1).numpy(), 0.0)
    return delta_v, injuries


def _format_ends(low: float, high: float) -> str:
    """Return an interval of a probability, or what it is below."""
    if low > 0:
        return f"{low:.1e} to {high:.1e}"
    return f"below {high:.1e}" if high < 1 else "not bounded"
