"""Failures driven once more: the severity of their collisions, their kinds of crash, and modes with shares of p.

Severity is P[collision with delta-v > v] over v, and the expected number of serious injuries. Failures of one kind of
crash are one mode, unless they lie in regions apart: clusters of density (HDBSCAN) in standard normal space that
together hold at least half of them. The rest belongs to the nearest cluster. Other drivers are put in the ego's place
in failing scenarios of each mode, to tell whether a person would have avoided the crash.

References:
    Campello, Moulavi and Sander, "Density-based clustering based on hierarchical density estimates", PAKDD 2013.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import samplers
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.egos.needs import RULE_BASED_EGOS
from rare_envs.plugins import EgoGone, one_line
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.registry import split_layout
from rare_envs.study.episodes import digest_scenarios, list_columns
from rare_envs.study.question import Study, build_problem
from rare_envs.study.replay import OWN_NOISE
from rare_envs.traffic.crash import CRASH_KINDS, NONE, OTHERS, Crash, describe_crash
from samplers import analysis
from samplers.analysis.weighted import choose_failures, require_sample
from samplers.method import EstimateData
from samplers.output import drawing_axes
from samplers.problem import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VARIES = "the ego's answers vary from run to run, so that its failures cannot be seen again"
"""Why crashes are not known."""
MAX_REPLAYED = 10_000
"""Largest number of failing points that are driven again, evenly spaced among all."""
MAX_REPLAYED_FURTHER = 2_000
"""The same of those of the run under the mixture of the refits, which count for the refits alone."""


class ReplayedFailures(NamedTuple):
    """Failing points of a run with their crashes."""

    failures: analysis.WeightedFailures
    """The points and their weights, those without an outcome included."""
    crash: Crash
    """Crashes of the points that have an outcome, in their order."""

    def severities(self, any_vehicle: bool) -> tuple[FloatArray, FloatArray]:
        """Return delta-v [m/s] (-inf without a collision) and expected injuries of each failing point, shape (k,)."""
        known = self.failures.has_outcome
        delta_v, injuries = np.full(len(known), -np.inf), np.zeros(len(known))
        delta_v[known], injuries[known] = measure_severity(self.crash, any_vehicle)
        return delta_v, injuries


def measure_severity(crash: Crash, any_vehicle: bool) -> tuple[FloatArray, FloatArray]:
    """Return delta-v [m/s] (-inf without a collision) and expected injuries of B episodes, shape (B,)."""
    kind = crash.kind.numpy()
    counts = (kind != NONE) & (any_vehicle | (kind != OTHERS))
    delta_v = np.where(counts, crash.delta_v.double().amax(dim=1).numpy(), -np.inf)
    return delta_v, np.where(counts, crash.injury_risk.double().sum(dim=1).numpy(), 0.0)


def replay_failures(
    problem: DrivingProblem, estimate: EstimateData, most: int | None = MAX_REPLAYED
) -> tuple[ReplayedFailures, ReplayedFailures | None]:
    """Drive failing points of a run once more, and those of its run under the mixture of the refits, if it has one."""
    if problem.varies:
        raise ValueError(f"{VARIES[0].upper()}{VARIES[1:]}.")

    def replay(run: EstimateData, most: int | None) -> ReplayedFailures:
        failures = analysis.weigh_failures(run, most)
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
    """How severe the collisions among the failures of a run are."""

    curve: analysis.Exceedance
    """P[failure in a collision with delta-v > v] over v [m/s], with simultaneous bands of the sampling and, if the
    base has refits, of its events."""
    largest_delta_v: float
    """Largest delta-v among the failures that were simulated again [m/s]."""
    injuries: analysis.FailureExpectation
    """Expected serious injuries per scenario, both vehicles together."""
    injuries_base: analysis.BaseUncertainty | None
    """Interval of the same that the events behind a fitted traffic model allow; None if it has no refits."""
    n_replayed: int
    """Failing scenarios that were simulated again for it; not in the run's n_sim."""
    n_failures: int
    """Failing scenarios that the run has."""
    unknown: float
    """Share of p from scenarios on which the ego failed: they have no delta-v and are left out."""

    def __str__(self) -> str:
        """Return a few lines for people."""
        curve, (low, high) = self.curve, self.injuries.interval
        known = [i for i, v in enumerate(curve.thresholds) if v in SHOWN_DELTA_V and curve.low[i] > 0]
        shown = {i: f"> {curve.thresholds[i]:g} m/s" for i in known[-SHOWN_THRESHOLDS:]}
        parts = [f"{v} {curve.p[i]:.1e} [{curve.low[i]:.1e}, {curve.high[i]:.1e}]" for i, v in shown.items()]
        lines = [f"collisions with delta-v {', '.join([*parts, f'at most {self.largest_delta_v:.2g} m/s'])}"]
        if curve.base is not None and shown:
            base = curve.base
            held = f"{100 * base.confidence:g} % of all thresholds together"
            parts = [f"{v} {_format_ends(base.low[i], base.high[i])}" for i, v in shown.items()]
            lines.append(f"  traffic model {held}  {', '.join(parts)} ({base.fitted_to}, {base.n_refits} refits)")
        lines.append(
            f"serious injuries (MAIS 3+) {self.injuries.value:.1e} per scenario [{low:.1e}, {high:.1e}], "
            f"{self.injuries.per_failure:.2g} per failure"
        )
        if self.injuries_base is not None:
            lines.append(f"  {self.injuries_base}".splitlines()[0].replace("base distribution", "traffic model"))
        lines.append(f"from {self.n_replayed:,} of {self.n_failures:,} failing scenarios, simulated again")
        if self.unknown:
            lines[-1] += f"; {100 * self.unknown:.2g} % of p have no outcome and are left out"
        return "\n".join(lines)

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
        """Draw P[collision with delta-v > v] over v with its bands; needs matplotlib."""
        with drawing_axes(ax) as axes:
            self.curve.plot(axes)
            axes.set(xlabel="delta-v [m/s]", ylabel="P[collision with a larger delta-v]")
            axes.set_title("How hard the collisions are")
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
    """Return the severity of failures that were driven again; None if none of them is a collision."""
    failures, any_vehicle = replayed.failures, problem.world.measurement.collisions == "any"
    delta_v, injuries = replayed.severities(any_vehicle)
    more: list[tuple[analysis.WeightedFailures, FloatArray] | None] = [None, None]
    if further is not None:
        more = [(further.failures, values) for values in further.severities(any_vehicle)]
    collided = np.isfinite(delta_v)
    if not collided.any():
        return None
    largest = float(delta_v[collided].max())
    if thresholds is None:
        step = DELTA_V_STEP if largest > FINE_UP_TO else FINE_STEP
        thresholds = step * np.arange(math.ceil(largest / step) or 1)
    expected = analysis.expect_over_failures(failures, injuries, estimate.confidence)
    return Severity(
        curve=analysis.compute_exceedance(estimate, failures, delta_v, thresholds, more[0]),
        largest_delta_v=largest,
        injuries=expected,
        injuries_base=analysis.expect_under_refits(estimate, failures, injuries, expected, more[1]),
        n_replayed=int(failures.has_outcome.sum()),
        n_failures=failures.total,
        unknown=float(failures.weights[~failures.has_outcome].sum() / failures.weights.sum()),
    )


def _format_ends(low: float, high: float) -> str:
    """Return an interval of a probability, or what it is below."""
    if low > 0:
        return f"{low:.1e} to {high:.1e}"
    return f"below {high:.1e}" if high < 1 else "not bounded"


MAX_CLUSTERED = 2000
"""Failing scenarios that are clustered, evenly spaced among all."""
LEAST_CLUSTER, LEAST_SHARE = 10, 0.05
"""Failures of a cluster at least, and their share among those of its kind."""
LEAST_CLUSTERED = 0.5
"""Share of the failures that must lie in clusters; fewer are the tails of one."""
KIND_DESCRIPTIONS = MappingProxyType(
    {
        "rear_end": "rear-end (ego strikes)",
        "rear_ended": "rear-end (ego struck)",
        "side": "sideswipe",
        "road_edge": "road departure",
        "others": "crash of other vehicles",
        "none": "no collision",
        "no outcome": "no answer from the ego",
    }
)
"""Kinds of crash in words."""
Crashes = Mapping[bytes, str]
"""Kinds of crash of failures that were driven again, by `digest_scenarios`."""
OTHER_DRIVERS = ("human", "cc_human", "idm")
"""Egos that drive the failing scenarios too, those of them that there are."""
ROWS_DRIVEN = 200
"""Failing scenarios of a mode in which each of them drives, and failures of the list, the most likely ones."""


class OtherDriver(NamedTuple):
    """What another driver does in failing scenarios."""

    fails: float
    """Share of them in which it fails too, by their weights."""
    n: int
    """How many different ones."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FailureMode:
    """One way to fail."""

    crash: str
    """Kind of crash; "" where that is not known."""
    share: samplers.analysis.Share
    """Its part of p, with an interval."""
    failure: int | None
    """Number of its most likely failure in the list of failures; None if the list has none of it."""
    center: Mapping[str, float]
    """Weighted mean of the parameters that are shown, by name."""
    drawn: FloatArray = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    """Failing scenarios of it, drawn by their weights, shape (n, d)."""
    others: Mapping[str, OtherDriver] = field(default_factory=dict)
    """What other drivers do in these, by name; empty if that is not known."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "crash": self.crash,
            **self.share.to_dict(),
            "interval": list(self.share.interval),
            "failure": self.failure,
            "center": dict(self.center),
            "other_drivers": {name: each._asdict() for name, each in self.others.items()},
        }


Labels = NDArray[np.object_]
"""Words, one for each of some points."""


def find_modes(space: ScenarioSpace, estimate: samplers.Estimate, crashes: Crashes) -> tuple[FailureMode, ...]:
    """Return the modes of failure of a run, the largest first; none if nothing failed or there are no weights."""
    found = assign_modes(space, estimate, crashes)
    if found is None:
        return ()
    sample, (rows, kinds, labels, listed) = require_sample(estimate), found
    x, weights = sample.x[rows], sample.weights[sample.f <= estimate.gamma][rows]
    modes = []
    for label, share in analysis.sum_by_label(estimate, rows, labels).items():
        mine, numbers = labels == label, np.flatnonzero(listed == label)
        mean = np.average(x[mine], axis=0, weights=weights[mine] if weights[mine].sum() > 0 else None)
        center = {column.name: float(mean[j]) for j, column in enumerate(list_columns(space)) if column.shown}
        failure, crash = int(numbers[0]) if len(numbers) else None, str(kinds[mine][0])
        drawn = x[mine][_draw_by_weight(weights[mine])]
        modes.append(FailureMode(crash=crash, share=share, failure=failure, center=center, drawn=drawn))
    return tuple(modes)


def _draw_by_weight(weights: FloatArray) -> NDArray[np.int64]:
    """Return `ROWS_DRIVEN` rows by their weights (n,), evenly spaced in the sum: heavy ones stand several times."""
    upto = np.cumsum(weights if weights.sum() > 0 else np.ones(len(weights)))
    places = (np.arange(ROWS_DRIVEN) + 0.5) / ROWS_DRIVEN * upto[-1]
    return np.asarray(np.minimum(np.searchsorted(upto, places), len(weights) - 1), dtype=np.int64)


def assign_modes(
    space: ScenarioSpace, estimate: samplers.Estimate, crashes: Crashes
) -> tuple[NDArray[np.int64], Labels, Labels, Labels] | None:
    """Return rows of `Sample.x` (k,) of failures with kinds and modes, and the modes of those listed; None without."""
    sample, listed = estimate.sample, estimate.failures
    if sample is None or not (sample.f <= estimate.gamma).any() or estimate.p <= 0:
        return None
    shown = [column.shown for column in list_columns(space)]
    rows = choose_failures(sample, estimate.gamma, MAX_REPLAYED)
    rows = rows[:: math.ceil(len(rows) / MAX_CLUSTERED)]
    f = sample.f[sample.f <= estimate.gamma][rows]
    kinds = _find_kinds(sample.x[rows], crashes, np.isneginf(f))
    kinds_listed = _find_kinds(listed.x, crashes, np.isnan(listed.f))
    u, u_listed = (space.to_standard_normal(x)[:, shown] for x in (sample.x[rows], listed.x))
    labels = label_modes(u, kinds)
    found = np.full(len(listed), "", dtype=object)
    for kind in dict.fromkeys(kinds_listed.tolist()):
        mine, like = kinds_listed == kind, np.flatnonzero(kinds == kind)
        if len(like):
            found[mine] = labels[like[_find_nearest(u_listed[mine], u[like])]]
    return rows, kinds, labels, found


def _find_kinds(x: FloatArray, crashes: Crashes, failed: NDArray[np.bool_] | None = None) -> Labels:
    """Return the kinds of crash of scenarios x (n, d), shape (n,); "" where that is not known, and if f failed."""
    kinds = np.array([crashes.get(digest, "") for digest in digest_scenarios(x)], dtype=object)
    if failed is not None:
        kinds[failed] = analysis.NO_OUTCOME_LABEL
    return kinds


def label_modes(u: FloatArray, kinds: Labels) -> Labels:
    """Return the mode, a word, of each of n failures u (n, k) in standard normal space with kinds of crash (n,)."""
    labels = np.empty(len(kinds), dtype=object)
    for kind in dict.fromkeys(kinds.tolist()):
        mine = np.flatnonzero(kinds == kind)
        clusters = cluster_points(u[mine]) if kind != analysis.NO_OUTCOME_LABEL else np.zeros(len(mine), dtype=np.int64)
        labels[mine] = [f"{kind}/{cluster}" for cluster in clusters]
    return labels


def cluster_points(u: FloatArray) -> NDArray[np.int64]:
    """Return the cluster of each point u (n, k), shape (n,); all 0 if no clusters stand apart."""
    from sklearn.cluster import HDBSCAN

    least = max(LEAST_CLUSTER, math.ceil(LEAST_SHARE * len(u)))
    if len(u) < 2 * least or u.shape[1] == 0:
        return np.zeros(len(u), dtype=np.int64)
    found = HDBSCAN(min_cluster_size=least, min_samples=LEAST_CLUSTER, copy=True).fit_predict(u)
    inside = found >= 0
    if inside.mean() < LEAST_CLUSTERED:
        return np.zeros(len(u), dtype=np.int64)
    return np.asarray(found[inside][_find_nearest(u, u[inside])], dtype=np.int64)


def _find_nearest(u: FloatArray, among: FloatArray) -> NDArray[np.int64]:
    """Return the index of the nearest of some points (m, k) to each of u (n, k), shape (n,)."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(among).query(u)[1], dtype=np.int64)


@dataclass(frozen=True)
class CrashKinds:
    """Crashes in which the failures of a run ended."""

    shares: Mapping[str, samplers.analysis.Share] = field(default_factory=dict)
    """p by kind of crash; its parts add up to p. Empty if nothing failed, or it is not known."""
    listed: tuple[dict[str, Any] | None, ...] = ()
    """The crash of each failure of the list, see `rare_envs.traffic.crash.describe_crash`; empty if it is not known."""
    unknown: str = ""
    """Reason why it is not known."""
    by_scenario: Crashes = field(default_factory=dict, repr=False)
    severity: Severity | None = None
    """How severe the collisions are; None if there are none, or it is not known."""
    modes: tuple[FailureMode, ...] = ()
    """Modes of failure, the largest first; empty if they are not known."""
    others_listed: Mapping[str, FloatArray] = field(default_factory=dict)
    """f of each failure of the list with another driver in the ego's place, by its name; NaN if it did not drive."""
    others_unknown: Mapping[str, str] = field(default_factory=dict)
    """Why others cannot drive here, by name."""
    n_others: int = 0
    """Simulations with other drivers; not in the run's n_sim."""

    def find_others(self, kind: str | None = None) -> dict[str, OtherDriver]:
        """Return what other drivers do in failing scenarios of one kind of crash, or of all, by name."""
        modes = [mode for mode in self.modes if mode.others and kind in (None, mode.crash)]
        shares = np.array([mode.share.of_failures for mode in modes])
        if not shares.sum() > 0:
            return {}
        found = {}
        for name in modes[0].others:
            each = [mode.others[name] for mode in modes]
            fails = float(shares @ [one.fails for one in each] / shares.sum())
            found[name] = OtherDriver(fails, sum(one.n for one in each))
        return found


def classify_failures(problem: DrivingProblem, estimate: samplers.Estimate) -> tuple[samplers.Estimate, CrashKinds]:
    """Drive failures of a run once more: those of its list, and for shares and severity `MAX_REPLAYED` of all."""
    estimate = replace(estimate, failures=_drop_repeated(estimate.failures))
    known, kinds = np.isfinite(estimate.failures.f), dict[bytes, str]()
    described: dict[bytes, dict[str, Any] | None] = {}

    def drive(x: FloatArray) -> None:
        crash = problem.crashes(x)
        kinds.update(_label_scenarios(x, crash))
        described.update((digest, describe_crash(crash, row)) for row, digest in enumerate(digest_scenarios(x)))

    shares: Mapping[str, samplers.analysis.Share] = {}
    severity = None
    if known.any():
        if problem.varies:
            return estimate, CrashKinds(unknown=VARIES)
        try:
            drive(estimate.failures.x[known])
            shares, severity = _weigh_crashes(problem, estimate, kinds)
        except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's, and need not do again what it did
            return estimate, CrashKinds(unknown=f"{type(error).__name__}: {error}")
        longer = list_every_mode(problem.space, estimate, kinds)
        with contextlib.suppress(Exception, SystemExit, EgoGone):  # likewise
            driven = np.array([digest in described for digest in digest_scenarios(longer.failures.x)])
            new = ~driven & np.isfinite(longer.failures.f)
            if new.any():
                drive(longer.failures.x[new])
            estimate = longer
    listed = tuple(described.get(digest) for digest in digest_scenarios(estimate.failures.x))
    modes = find_modes(problem.space, estimate, kinds)
    return estimate, CrashKinds(shares, listed, by_scenario=kinds, severity=severity, modes=modes)


def drive_by_others(study: Study, estimate: samplers.Estimate, kinds: CrashKinds) -> CrashKinds:
    """Put other drivers in the ego's place in the failures of the list, and in failing scenarios of each mode.

    They meet the same traffic. Noise of their own is drawn anew, or is that of the ego where it is of their kind.
    """
    if not kinds.modes:
        return kinds
    most_likely = [mode.failure for mode in kinds.modes if mode.failure is not None]
    listed = np.union1d(np.arange(min(len(estimate.failures), ROWS_DRIVEN)), most_likely).astype(np.int64)
    x = np.vstack([estimate.failures.x[listed], *(mode.drawn for mode in kinds.modes)])
    # layouts are for policies, and so are kinds of observation, actions and cores
    of_ego: dict[str, Any] = {"observation": None, "action": None, "core": "auto", "device": "cpu"}
    question = replace(study.question, env_id=split_layout(study.question.env_id)[0], **of_ego)
    f, unknown = dict[str, FloatArray](), dict[str, str]()
    for name in filter(RULE_BASED_EGOS.__contains__, OTHER_DRIVERS):
        try:
            f[name] = _drive_instead(build_problem(question, name), study.problem, x)
        except Exception as error:  # measures may be the user's
            unknown[name] = one_line(error)
    first, modes = len(listed), list[FailureMode]()
    for mode in kinds.modes:
        rows = slice(first, first := first + len(mode.drawn))
        fails = {name: float(np.mean(each[rows] <= estimate.gamma)) for name, each in f.items()}
        counts = np.unique(mode.drawn, axis=0, return_counts=True)[1]
        n = round(counts.sum() ** 2 / (counts**2).sum()) if len(counts) else 0  # effective, as a heavy one comes often
        modes.append(replace(mode, others={name: OtherDriver(share, n) for name, share in fails.items()}))
    of_list = {name: np.full(len(estimate.failures), np.nan) for name in f}
    for name, each in f.items():
        of_list[name][listed] = each[: len(listed)]
    n_others = len(f) * len(x)
    return replace(kinds, modes=tuple(modes), others_listed=of_list, others_unknown=unknown, n_others=n_others)


def _drive_instead(other: DrivingProblem, problem: DrivingProblem, x: FloatArray) -> FloatArray:
    """Return f (n,) of scenarios x (n, d) of a problem with the driver of another one in the place of its ego."""
    rng, known, parts = np.random.default_rng(0), problem.space.columns(x), list[FloatArray]()
    if type(other.needs.noise) is not type(problem.needs.noise):
        known.pop(OWN_NOISE, None)
    for name, size in zip(other.space.names, other.space.sizes, strict=True):
        parts.append(known[name].reshape(len(x), -1) if name in known else rng.standard_normal((len(x), size)))
        if parts[-1].shape[1] != size:
            raise ValueError(f"its traffic has {size} values of {name}, that of the ego {parts[-1].shape[1]}")
    return other.evaluate(np.hstack(parts))


def _drop_repeated(failures: samplers.Failures) -> samplers.Failures:
    """Return failures without those whose scenario is listed before, as chains that stay in a place make them."""
    first = {digest: row for row, digest in reversed(list(enumerate(digest_scenarios(failures.x))))}
    rows = sorted(first.values())
    return replace(failures, x=failures.x[rows], f=failures.f[rows], log_p0=failures.log_p0[rows])


def _weigh_crashes(
    problem: DrivingProblem, estimate: samplers.Estimate, by_scenario: dict[bytes, str]
) -> tuple[dict[str, samplers.analysis.Share], Severity | None]:
    """Return p by kind of crash and the severity, from failing points that are driven again once for both."""
    if estimate.sample is None or not estimate.p:  # no failures, or the search's alone
        return {}, None
    replayed, further = replay_failures(problem, estimate)
    failures = replayed.failures
    labels = np.full(len(failures.rows), analysis.NO_OUTCOME_LABEL, dtype=object)
    by_scenario |= _label_scenarios(failures.x[failures.has_outcome], replayed.crash)
    labels[failures.has_outcome] = [CRASH_KINDS[kind] for kind in replayed.crash.kind]
    shares = analysis.sum_by_label(estimate, failures.rows, labels)
    return shares, compute_severity(problem, estimate, replayed, further)


def _label_scenarios(x: FloatArray, crash: Crash) -> dict[bytes, str]:
    """Return the kinds of crash of scenarios x (k, d), by their digest."""
    return {key: CRASH_KINDS[int(kind)] for key, kind in zip(digest_scenarios(x), crash.kind, strict=True)}


def list_every_mode(space: ScenarioSpace, estimate: samplers.Estimate, crashes: Crashes) -> samplers.Estimate:
    """Return an estimate that lists a failure of each mode and kind of crash."""
    failures, sample = estimate.failures, estimate.sample
    if failures.total <= len(failures) or sample is None or estimate.p <= 0:
        return estimate
    rows = choose_failures(sample, estimate.gamma, MAX_REPLAYED)
    kinds, listed = (_find_kinds(x, crashes) for x in (sample.x[rows], failures.x))
    longer = _list_more(estimate, rows, kinds, {*listed, ""})
    found = assign_modes(space, longer, crashes)
    if found is None:
        return longer
    rows, _, labels, modes = found
    return _list_more(longer, rows, labels, {*modes, f"{analysis.NO_OUTCOME_LABEL}/0", "/0"})


def _list_more(
    estimate: samplers.Estimate, rows: NDArray[np.int64], labels: Labels, known: set[Any]
) -> samplers.Estimate:
    """Return an estimate whose list has the most likely of the rows of `Sample.x` of each label that is not known."""
    missing = [labels == label for label in dict.fromkeys(labels.tolist()) if label not in known]
    if not missing:
        return estimate
    if estimate.base is None:
        raise ValueError("The estimate does not know its traffic model (`Estimate.base` is None).")
    sample, failures = require_sample(estimate), estimate.failures
    log_density = np.asarray(estimate.base.log_prob(sample.x[rows]), dtype=np.float64)
    best = [int(np.argmax(np.where(mine, log_density, -np.inf))) for mine in missing]
    f = sample.f[sample.f <= estimate.gamma][rows[best]]
    more = failures.merge(sample.x[rows[best]], f, log_density[best], keep=len(failures) + len(best))
    return replace(estimate, failures=replace(more, total=failures.total))
