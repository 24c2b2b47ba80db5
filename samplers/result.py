"""Result: the estimate that `estimate` returns."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from samplers.analysis.base_error import BaseUncertainty, compute_base_uncertainty
from samplers.analysis.curve import Curve, compute_curve, lowest_known_threshold
from samplers.analysis.gate import Pilot, Verdict, find_ends, judge_estimate
from samplers.analysis.reweight import Reweighted, reweight_estimate
from samplers.analysis.sensitivity import Sensitivity, compute_sensitivity
from samplers.analysis.weighted import Share, require_sample, split_by_kind
from samplers.method import Choice, EstimateData, Outcome, Part, Stepping
from samplers.output import (
    Kept,
    Row,
    StoredMethod,
    arrow_table,
    drawing_axes,
    fold_rows,
    format_alike,
    indent_lines,
    is_stored,
    read_object,
    register_stored,
    say,
    to_json_value,
)
from samplers.problem import Distribution, FloatArray
from samplers.sample import (
    Closest,
    DrawWeights,
    Failures,
    Interval,
    Layer,
    Level,
    Sample,
    SimulatedPoints,
    Status,
    describe_outcome,
)

if TYPE_CHECKING:
    import pyarrow
    from matplotlib.axes import Axes


NEGLIGIBLE = 0.1
"""Share of the squared width of an interval below which its source does not limit it."""
NAMED_STRATA = 2
"""Strata without enough failures that are named."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Estimate(EstimateData, Kept):
    """P[f(X) <= gamma] with its interval, its cost and its failures.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.5 - x.sum(axis=1) / 10**0.5, dim=10)
        >>> result = samplers.estimate(problem, seed=0, max_sim=6000)  # P = Phi(-3.5) = 2.326e-4
        >>> print(f"{result.p:.2e}, c.o.v. {result.cov:.2f}, {result.n_sim} simulations, {result.status}")
        2.32e-04, c.o.v. 0.01, 6000 simulations, converged
        >>> low, high = result.interval
        >>> low < 2.326e-4 < high, result.warnings
        (True, ())
    """

    @property
    def unseen(self) -> float:
        """Largest probability M of a region of failure, of any shape, that may have been missed by all base draws.

        M = 1 - (1 - confidence)^(1 / n) for n base draws, about 3 / n, the one-sided Clopper-Pearson bound without a
        hit: n draws all miss a larger region with probability under 1 - confidence. M = 1 without base draws. Levels
        of f and chains may find far smaller regions, but guarantee nothing. A region may lie in several strata.
        """
        return self.bound_missed(self.confidence)

    def curve(self, gammas: ArrayLike) -> Curve:
        """Return P[f(X) <= g] for other thresholds g from the same simulations, with a simultaneous band.

        Thresholds above gamma were passed on the way. Below gamma the curve goes on as long as the
        points there have at least 5 effective independent units (draws; paths, in subset simulation).

        Args:
            gammas: Thresholds, shape (k,), in any order.

        Raises:
            ValueError: If a threshold lies below what is known (the text names the smallest one),
                or the method gave no weighted points.

        Example:
            >>> import samplers
            >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
            >>> result = samplers.estimate(problem, "ce", seed=0, max_sim=10_000)
            >>> print(result.curve([0.0, 1.0]))  # Phi(-3) and Phi(-2): 1.35e-3 and 2.28e-2
                       g  P[f <= g]   95 % band
                       0  1.338e-03   [1.286e-03, 1.392e-03]
                       1  2.211e-02   [2.037e-02, 2.399e-02]

        """
        return compute_curve(self, gammas)

    def reweight(self, new_base: Any) -> Reweighted:
        """Return P[f(X) <= gamma] with X from another base distribution, from the same simulations.

        Every failing point counts with the ratio of the densities. That works near the old base: where the new one has
        its mass among points that were hardly drawn, the effective number of units drops and the answer is refused. A
        failure region that was never drawn from, because the old base gives it little or no density, cannot be seen,
        and no interval shows it. If `new_base` can be sampled, draws from it tell whether it reaches beyond the old
        support.

        Args:
            new_base: The other distribution of X: an object whose `log_prob` of points (n, d) in physical space gives
                (n,); or a frozen distribution of `scipy.stats`, one of OpenTURNS, or a list of them, as for
                `FunctionProblem(base=...)`; or the name of one that the base of this run knows (its `sibling`).

        Raises:
            ValueError: If the effective number of units or points is too small, the new base has
                density where the old has none, it does not fit, nothing failed, or the method gave
                no weighted points.

        Example:
            >>> import samplers
            >>> from scipy import stats
            >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
            >>> result = samplers.estimate(problem, seed=0, max_sim=4000)
            >>> print(f"{result.reweight(stats.multivariate_normal([0.5, 0.0])).p:.3f}")  # Phi(-2.5) = 0.0062
            0.006
        """
        return reweight_estimate(self, new_base)

    @cached_property
    def base_uncertainty(self) -> BaseUncertainty | None:
        """The interval of p that the events behind a fitted base distribution allow, from the same simulations.

        None if the base has no refits; see `BaseUncertainty` and `samplers.analysis.FittedBase`.
        """
        return compute_base_uncertainty(self)

    def meets(self, max_p: float, given_base: bool = False) -> Verdict:
        """Return whether p is below a limit: it passes, fails, or is undecided.

        Both limits of the interval (of `sequence`, if the run stopped on what it saw) are one-sided at the confidence
        (1 + `confidence`) / 2: take `confidence=0.9` for a test at 95 %. If the base distribution was fitted, they
        include the uncertainty from few events.

        Args:
            max_p: The limit.
            given_base: Take the base distribution as given instead.

        Raises:
            ValueError: If the limit is not above 0 and below 1.
        """
        return judge_estimate(self, max_p, None if given_base else self.base_uncertainty)

    def pilot(self, seconds: float | None = None) -> Pilot:
        """Return this run as one that others are planned from, by `samplers.plan`.

        Args:
            seconds: Its wall time [s].

        Raises:
            ValueError: If nothing failed, or the c.o.v. is above 0.5.

        Example:
            >>> import samplers
            >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
            >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000)  # 16 hits
            >>> [(run.n_sim, run.seconds) for run in samplers.plan(result.pilot(seconds=5.0), target_cov=0.1)]
            [(62400, 31.2)]
        """
        again = self.method.stops_at_target and self.sample is not None
        draws = self.sample.n_units if again and self.sample is not None else None
        return Pilot(
            method=self.method.name,
            p=self.p,
            cov=self.cov,
            n_sim=self.n_sim,
            final_draws=draws,
            seconds=seconds,
            strata=tuple((part.share, part.p) for part in self.parts),
        )

    def shares(self, label: Callable[[FloatArray], Sequence[str]], most: int | None = None) -> dict[str, Share]:
        """Return p by kind of failure, from the same simulations; the kinds' p add up to p.

        Args:
            label: Says of failing points (k, d), in physical space, what kind of failure each is: k words.
            most: Look at no more failing points than this, evenly spaced among them; None for all.

        Raises:
            ValueError: If the method gave no weighted points, or label does not give k words.

        Example:
            >>> import numpy as np, samplers
            >>> problem = samplers.FunctionProblem(lambda x: 3.0 - np.abs(x[:, 0]), dim=2)
            >>> result = samplers.estimate(problem, seed=0, max_sim=4000)
            >>> shares = result.shares(lambda x: np.where(x[:, 0] > 0, "right", "left").tolist())
            >>> for side in ("left", "right"):
            ...     print(f"{side} {shares[side].p:.5f}, {shares[side].of_failures:.0%} of p")
            left 0.00135, 50% of p
            right 0.00135, 50% of p
        """
        return split_by_kind(self, label, most)

    def sensitivity(self, names: Sequence[str] = (), sizes: Sequence[int] = (), parameters: bool = True) -> Sensitivity:
        """Return what p is sensitive to: parameters of the base distribution, and columns of x; no new simulations.

        If the base offers its parameters (`parameters`, `with_parameters`), d log p / d theta is the score function
        averaged over the failing points. If it also has refits, the spread of log p over them is split among the
        parameters to first order, which tells what recordings would narrow the interval most.

        Args:
            names: Names of the parameters of x, for the tables; by default those of the problem, or x1, x2, ...
            sizes: Columns of x that each takes; one by default.
            parameters: Whether derivatives by the parameters of the base are wanted too.

        Raises:
            ValueError: If the method gave no weighted points, fewer than two points failed, the base is not known, or
                names and sizes do not fit.
        """
        return compute_sensitivity(self, names or (() if sizes else self.column_names), sizes, parameters)

    @property
    def proviso(self) -> str:
        """What is not in p and its interval: what the problem holds fixed, and failure regions that were missed."""
        fixed = f"given that {self.given}; " if self.given else ""
        by = f"({self.base_draws:,} base draws, {100 * self.confidence:g} % confidence)"
        return f"{fixed}a failure region that the search missed: below {self.unseen:.1e} {by}"

    def plot(self, ax: "Axes | str | PathLike[str] | None" = None) -> "Axes":
        """Draw P[f <= g] over thresholds g with its band, and p with its interval at gamma; needs matplotlib.

        Raises:
            ValueError: If the method gave no weighted points, or too few of them to draw a curve.
        """
        sample = require_sample(self)
        finite = sample.f[np.isfinite(sample.f)]
        low = max(lowest_known_threshold(sample, self.gamma), finite.min(initial=math.inf))
        if not math.isfinite(low):
            raise ValueError("There is nothing to draw: too few simulations came near failure; raise max_sim.")
        order = np.argsort(finite)
        reached = np.cumsum(sample.weights[np.isfinite(sample.f)][order])
        high = float(finite[order][min(np.searchsorted(reached, reached[-1] / 2), len(order) - 1)])
        grid = np.unique([*np.linspace(low, max(low, high, self.gamma), 60), max(low, self.gamma)])
        with drawing_axes(ax) as axes:
            self.curve(grid).plot(axes)
            axes.axvline(self.gamma, linestyle=":", color="0.4")
            if self.p > 0:
                below, above = self.p - self.interval[0], self.interval[1] - self.p
                axes.errorbar([self.gamma], [self.p], yerr=[[below], [above]], fmt="o", capsize=4, color="0.2")
            axes.set_title(f"P[f ≤ {self.gamma:g}] = {self.p:.2e}")
        return axes

    @property
    def headline(self) -> str:
        """P in words or, if p = 0, the bound and what it rests on."""
        if self.p > 0:
            return f"P[f <= {self.gamma:g}] = {self.p:.3e}"
        failing = f"only {self.failures.total:,} of the search" if self.failures.total else "no failure"
        about = f"{failing} in {self.n_sim:,} simulations"
        return f"P[f <= {self.gamma:g}] below {self.interval[1]:.1e} ({100 * self.confidence:g} %): {about}"

    def __repr__(self) -> str:
        ends, ended = "[{:.3e}, {:.3e}]".format(*self.interval), describe_outcome(self.status, self.warnings)
        return f"<Estimate {self.headline} {ends}, {self.n_sim:,} simulations, {self.method.name}, {ended}>"

    def __str__(self) -> str:
        more = ("Details", say("next", command="result.details()", what=say("details")))
        base = self.base_uncertainty
        warnings = list_warnings([*self.warnings, *([] if base is None else base.warnings)])
        return "\n".join(fold_rows([*list_facts(self), *warnings, more]))

    def details(self) -> str:
        """Return everything that is known of p, in a text: all intervals, c.o.v., gain, method, remarks, warnings.

        Example:
            >>> import samplers
            >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
            >>> print(samplers.estimate(problem, "mc", seed=0, max_sim=10_000).details())
            P[f <= 0] = 2.370e-02
              95 % interval [2.081e-02, 2.687e-02], c.o.v. 0.0642
              10,000 simulations, gain over Monte Carlo 1; mc, seed 0, converged; 237 failing points
              a failure region that the search missed: below 3.0e-04 (10,000 base draws, 95 % confidence)
        """
        (low, high), looks = self.interval, self.sequence
        gain = "" if math.isnan(self.gain) else f", gain over Monte Carlo {self.gain:.3g}"
        cov = "not known" if math.isinf(self.cov) else f"{self.cov:.3g}"
        lines = [
            self.headline,
            f"  {100 * self.confidence:g} % interval [{low:.3e}, {high:.3e}], c.o.v. {cov}",
            *(["  at every look [{:.3e}, {:.3e}], as the run stopped on what it saw".format(*looks)] if looks else []),
            *(f"  {part}" for part in self.parts),
            *indent_lines(self.base_uncertainty),
            f"  {self.n_sim:,} simulations{gain}; {self.method.name}, seed {self.seed}, "
            f"{describe_outcome(self.status, self.warnings)}; {self.failures.total:,} failing points",
            *([f"  chosen {self.choice}"] if self.chosen is not None and self.chosen.unusual else []),
            f"  {self.proviso}",
        ]
        lines += [f"  remark: {text}" for text in self.remarks]
        return "\n".join(lines + [f"  warning: {text}" for text in self.warnings])

    def to_arrow(self, names: Sequence[str] = ()) -> "pyarrow.Table":
        """Return simulated points with their weights as an Arrow table, a row each.

        With `estimate(..., keep_points=True)` these are all simulations in their order: `f`, `weight` (its share in p
        if it fails; null for those of a search, and for Markov chains, whose points stand for each other), `run`
        (replicate), `stage` (level in its trace), `failed` and the coordinates of x. Otherwise they are the points
        behind p (`Estimate.sample`): `f`, `weight`, `unit` and `failed` of all, and x of the failing ones, null
        elsewhere. The folder of a run of `rare-envs estimate --out` has the first table as `episodes.parquet`
        (`rare_envs.load_study(folder).episodes()`); a journal keeps outcomes only.

        Args:
            names: Names of the coordinates; by default those of the problem (`x.f` for one named as another column),
                or x1, x2, ...

        Raises:
            ValueError: If the method gave no weighted points, or names do not fit.

        Example:
            >>> import samplers
            >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
            >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000, keep_points=True)
            >>> table = result.to_arrow()
            >>> table.column_names, table.num_rows
            (['f', 'weight', 'run', 'stage', 'failed', 'x1', 'x2'], 10000)
            >>> round(sum(table.filter(table["failed"])["weight"].to_pylist()), 6), result.p
            (0.0016, 0.0016)
        """
        columns: dict[str, Any]
        if self.points is None:
            sample = require_sample(self)
            f, x, failed = sample.f, sample.x, sample.f <= self.gamma
            columns = {"f": f, "weight": sample.weights, "unit": sample.units, "failed": failed}
            rows, missing = np.flatnonzero(failed), {"f": np.isneginf(f)}
        else:
            f, x, lost = self.points.f, self.points.x, np.isnan(self.points.f)
            about = self.describe_simulations(0, len(f))
            weight, failed = np.exp(about.log_weight), lost | (f <= self.gamma)
            columns = {"f": f, "weight": weight, "run": about.run, "stage": about.stage, "failed": failed}
            rows, missing = np.arange(len(f)), {"f": lost, "weight": np.isnan(weight), "stage": about.stage < 0}
        own = [f"x.{name}" if name in columns else name for name in self.column_names]
        return arrow_table(columns, missing, x, rows, names or own)

    def _as_stored(self) -> "StoredEstimate":
        return StoredEstimate(without_base(self), self.base_uncertainty)  # the base is code

    @classmethod
    def load(cls, path: str | PathLike[str], base: Distribution | None = None) -> "Estimate":
        """Return the estimate that `save` has written.

        Args:
            path: Path of the file, in the format safetensors with JSON in its metadata.
            base: The base distribution (`problem.base`), which `reweight` and `sensitivity` need; `base_uncertainty`
                is kept without it. A method of another package comes back as its name and settings.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If the file is damaged, or of something else.

        Example:
            >>> import samplers
            >>> from tempfile import TemporaryDirectory
            >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
            >>> result = samplers.estimate(problem, seed=0, max_sim=2000)
            >>> with TemporaryDirectory() as folder:
            ...     result.save(f"{folder}/result.safetensors")
            ...     samplers.Estimate.load(f"{folder}/result.safetensors") == result
            True
        """
        stored = read_object(path, StoredEstimate)
        if base is not None:
            return replace(stored.estimate, base=base)
        vars(stored.estimate)["base_uncertainty"] = stored.base_uncertainty  # its place once it is computed
        return stored.estimate

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, numbers and strings for JSON; NaN and infinities become None."""
        plain = "p interval sequence confidence cov gamma n_sim base_draws unseen given gain remarks seed"
        plain += " base_uncertainty warnings choice closest trace failures"
        data = {name: getattr(self, name) for name in plain.split()} | {
            "text": str(self),
            "final_draws": None if self.sample is None else self.sample.n_units,
            "parts": [part.to_dict() for part in self.parts],
            "status": str(self.status),
            "method": {"name": self.method.name, "settings": method_settings(self.method)},
        }
        return cast(dict[str, Any], to_json_value(data))

    def to_json(self) -> str:
        """Return `to_dict` as one line of JSON."""
        return json.dumps(self.to_dict(), allow_nan=False)


def method_settings(method: Stepping) -> dict[str, Any]:
    """Return the settings of a method as plain values."""
    # fields by name
    return {each.name: getattr(method, each.name) for each in fields(method)} if is_dataclass(method) else {}


_EstimateT = TypeVar("_EstimateT", bound=EstimateData)


@dataclass(frozen=True)
class StoredEstimate:
    """An estimate as a file has it."""

    estimate: Estimate
    base_uncertainty: BaseUncertainty | None


def without_base(estimate: _EstimateT) -> _EstimateT:
    """Return an estimate without what a file cannot hold."""
    method, further = estimate.method, estimate.ensemble_run
    if not is_stored(method):
        settings = {name: repr(value) for name, value in method_settings(method).items()}
        method = cast(Stepping, StoredMethod(method.name, method.stops_at_target, settings))
    return replace(
        estimate,
        base=None,
        method=method,
        ensemble_run=None if further is None else without_base(further),
        refit_ratios=[],
    )


def list_facts(
    estimate: Estimate, name: str = "", noun: str = "", model: str = "base distribution", left_out: str = ""
) -> list[Row]:
    """Return p with its widest interval, what limits that, and what the run may have missed, each in a sentence.

    `name` is that of p, by default P[f <= gamma]; `noun` is what p is a share of, in the plural; `model` what x is
    drawn from; `left_out` the errors that the interval leaves out.
    """
    base, sure = estimate.base_uncertainty, f"{100 * estimate.confidence:g} %"
    if base is not None and base.interval is None and base.bound is None and not left_out:
        left_out = say("error not known", model=model, reason=base.reason)
    unseen, own, ends = estimate.unseen, estimate.sequence or estimate.interval, find_ends(estimate, base)
    vague = sorted(((p.share * p.interval[1], p.name) for p in estimate.parts if not p.resolved), reverse=True)
    few = "".join(say("too few failures", name=part, high=format_alike(high)[0]) for high, part in vague[:NAMED_STRATA])
    few += f"; {len(vague) - NAMED_STRATA} more strata" if len(vague) > NAMED_STRATA else ""
    missed = say("may miss" if unseen < 1 else "may miss anything", unseen=format_alike(unseen)[0], sure=sure)
    rows = {
        name or f"P[f <= {estimate.gamma:g}]": _describe_p(estimate, noun),
        "Given": estimate.given,
        "Limited by": describe_limit(estimate.p, own, ends, f"{estimate.n_sim:,}", model, base, few),
        "Left out": left_out,
        "May miss": missed,
    }
    return [row for row in rows.items() if row[1]]


def list_warnings(warnings: Sequence[str]) -> list[Row]:
    """Return the first warning, and how many more there are; nothing without one."""
    if len(warnings) < 2:
        return [("Warning", warning) for warning in warnings]
    return [("Warning", say("warnings", first=warnings[0], more=len(warnings) - 1))]


def _describe_p(estimate: Estimate, noun: str) -> str:
    """Return p with its widest interval."""
    sure, found = f"{100 * estimate.confidence:g} %", estimate.failures.total
    low, high = find_ends(estimate, estimate.base_uncertainty)
    if estimate.p == 0:
        high = max(high, estimate.bound_missed(0.5 + estimate.confidence / 2))  # that of a search may be far lower
        fact = "failures of the search alone" if found else "nothing failed"
        return say(fact, n=f"{estimate.n_sim:,}", found=f"{found:,}", high=format_alike(high)[0], sure=sure)
    odds = describe_odds(estimate.p, noun)
    p, below, above = format_alike(estimate.p, low, high)
    fact = "p" if low > 0 else "p without a lower limit" if high < 1 else "p without limits"
    return say(fact, p=p, odds=odds, low=below, high=above, sure=sure)


def describe_odds(p: float, noun: str = "") -> str:
    """Return a small p as " (1 in n)", of what `noun` says; empty if it is large, or too small to be read so."""
    return f" (1 in {float(f'{1 / p:.2g}'):,.0f}{noun and f' {noun}'})" if 1e-9 < p < 0.1 else ""


def describe_limit(
    value: float, own: Interval, ends: Interval, n: str, model: str, base: BaseUncertainty | None, few: str = ""
) -> str:
    """Return whether events or n simulations limit the interval `ends` of a value; `own` is that of simulations alone.

    The share of the simulations is that in the squared upper half of log value.
    """
    of_events = 0.0
    if 0 < value < ends[1]:
        of_events = 1 - min(1.0, (math.log(max(own[1], value) / value) / math.log(ends[1] / value)) ** 2)
    if base is None or of_events < NEGLIGIBLE:
        return say("limited by simulations", n=n, few=few)
    low, high = format_alike(*own)
    exact = say("if the model is exact", low=low, high=high, model=model)
    fact = "limited by events" if of_events > 1 - NEGLIGIBLE else "limited by both"
    share, rest = (f"{100 * part:.0f} %" for part in (of_events, 1 - of_events))
    return say(fact, events=base.fitted_to, n=n, few=few, share=share, rest=rest, exact=exact)


register_stored(StoredEstimate, Estimate, Outcome, Part, BaseUncertainty, Failures, Level, Status, StoredMethod)
register_stored(Sample, Layer, DrawWeights, SimulatedPoints, Choice, Closest)
