"""Comparison: the ratio of two probabilities of failure, from the same draws for both."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy.special import stdtrit

from samplers.analysis.base_error import BaseUncertainty, summarise_refits
from samplers.analysis.gate import Verdict, find_doubt, judge_ends
from samplers.analysis.reweight import MAX_LOG, RefitSums, find_fitted_base, reweight_runs_to_refits
from samplers.analysis.weighted import (
    cov_inflation,
    find_missed,
    has_independent_points,
    interval_of_sum,
    require_sample,
)
from samplers.estimation import estimate
from samplers.method import Stepping
from samplers.methods import Auto
from samplers.output import (
    LABEL,
    Kept,
    Row,
    fold_rows,
    format_alike,
    indent_lines,
    register_stored,
    say,
    to_json_value,
)
from samplers.problem import FloatArray, Problem, check_number, check_whole, names_of_columns, one_per_row
from samplers.replicate import UNRESOLVED_SHARE
from samplers.result import Estimate, describe_limit, describe_odds, list_warnings, without_base
from samplers.run import Listener, RunArguments, check_problem
from samplers.sample import Interval, bound_missed, degrees_of_freedom, effective_number

__all__ = ["Comparison"]

if TYPE_CHECKING:
    import pyarrow

RATIO_COARSE = "the ratio is imprecise"
"""Words of the warnings that say how imprecise the ratio is, which its interval includes."""
UNLIMITED = 1e6
"""Upper over lower limit of a ratio from which on it is said to have none."""


@dataclass(frozen=True, kw_only=True)
class Side:
    """P[f(X) <= gamma] of one of the two problems, with its interval at the `confidence` of the comparison.

    `cov` is inf if p = 0; `ess` is the effective number of independent failing units behind p.
    """

    p: float
    interval: Interval
    cov: float
    ess: float


@dataclass(frozen=True, kw_only=True)
class Comparison(Kept):
    """p_A / p_B from the same draws with the same weights.

    Example:
        >>> import samplers
        >>> a, b = (samplers.FunctionProblem(lambda x, at=at: at - x[:, 0], dim=2) for at in (3.0, 3.2))
        >>> comparison = samplers.compare(a, b, seed=1, max_sim=8000)
        >>> comparison.n_sim, comparison.interval[0] < 1.965 < comparison.interval[1]  # Phi(-3) / Phi(-3.2)
        (8000, True)
        >>> round(comparison.both / comparison.b.p, 2)  # B fails where A does
        1.0
    """

    ratio: float
    """p_A / p_B; inf if p_B = 0, NaN if both are 0."""
    interval: Interval
    """Interval that should hold the true ratio with probability `confidence`."""
    confidence: float
    """Nominal coverage of the intervals."""
    a: Side
    """A by itself."""
    b: Side
    """B by itself."""
    parts: Mapping[str, Side]
    """P[both fail], P[only A] and P[only B], by the names "both", "only_a" and "only_b"."""
    n_sim: int
    """Simulations of A and of B together."""
    warnings: tuple[str, ...]
    """Reasons for which the numbers may be wrong."""
    either: Estimate = field(repr=False)
    """P[A or B fails], from which all this comes."""
    f: FloatArray = field(repr=False, compare=False)
    """f of A and of B at the failures that `either` lists, shape (2, m)."""
    base_uncertainty: BaseUncertainty | None = None
    """The interval of the ratio that the events behind a fitted base allow; None for a base without refits."""

    def meets(self, max_ratio: float, given_base: bool = False) -> Verdict:
        """Return whether p_B / p_A is below a limit, so that B fails at most so many times as often as A.

        Args:
            max_ratio: The limit.
            given_base: Take the base distribution as exact, as in `Estimate.meets`.

        Raises:
            ValueError: If the limit is not above 0.

        Example:
            >>> import samplers
            >>> a, b = (samplers.FunctionProblem(lambda x, at=at: at - x[:, 0], dim=2) for at in (3.0, 3.2))
            >>> print(samplers.compare(a, b, seed=1, max_sim=8000, confidence=0.9).meets(1.0).decision)
            passes
        """
        check_number("max_ratio", max_ratio, 0.0, math.inf)
        base, ends = None if given_base else self.base_uncertainty, self.interval
        reason = find_doubt([each for each in self.warnings if RATIO_COARSE not in each])
        reason = "no failure of A or B was found" if math.isnan(self.ratio) else reason
        if base is not None:
            ends = base.interval or (0.0, math.inf)
            doubt = "" if base.interval else base.reason.rstrip(".")
            reason = reason or doubt or find_doubt(base.warnings)
        low, high = (math.inf if end == 0 else 1.0 / end for end in reversed(ends))
        if_exact = None if base is None else self.meets(max_ratio, True).decision
        about: dict[str, Any] = {"includes_base": base is not None, "if_exact": if_exact, "quantity": "p_B / p_A"}
        return judge_ends(max_ratio, (low, high), self.confidence, reason, **about)

    def weigh(self, values: Callable[[FloatArray], FloatArray]) -> "Comparison":
        """Return the comparison of expected values over failures, such as injuries, in place of probabilities.

        With v_A and v_B, 0 if the one does not fail, the ratio is E[v_A] / E[v_B], and the parts are E[min(v_A,
        v_B)] of both and E[max(v_A - v_B, 0)] of A alone. Nothing is simulated but what `values` does.

        Args:
            values: Returns v_A and v_B >= 0 at points x (k, d) where A or B fails, shape (2, k).

        Example:
            >>> import numpy as np, samplers
            >>> a, b = (samplers.FunctionProblem(lambda x, at=at: at - x[:, 0], dim=2) for at in (3.0, 3.2))
            >>> found = samplers.compare(a, b, seed=1, max_sim=8000).weigh(lambda x: np.stack([x[:, 0] > 3.5] * 2))
            >>> round(found.ratio, 2), found.parts["only_a"].p
            (1.0, 0.0)
        """
        return _summarise(self.either, values, self.n_sim, self.f)

    @property
    def both(self) -> float:
        """P[both fail]."""
        return self.parts["both"].p

    @property
    def shares(self) -> dict[str, float]:
        """P[both fail], P[only A], P[only B] and P[neither], which add up to 1."""
        failing = {name: side.p for name, side in self.parts.items()}
        return {**failing, "neither": 1.0 - sum(failing.values())}

    @property
    def share_intervals(self) -> dict[str, Interval]:
        """Intervals of `shares`, each by itself."""
        low, high = self.either.interval
        return {**{name: side.interval for name, side in self.parts.items()}, "neither": (1.0 - high, 1.0 - low)}

    def to_arrow(self, names: Sequence[str] = ()) -> "pyarrow.Table":
        """Return the simulated points behind both, as `Estimate.to_arrow` of `either`; f is the smaller outcome."""
        return self.either.to_arrow(names)

    def _as_stored(self) -> "Comparison":
        return replace(self, either=without_base(self.either))

    @property
    def _has_ratio(self) -> bool:  # more than a bound: both failed
        return math.isfinite(self.ratio) and self.ratio > 0

    @property
    def _ratio_text(self) -> str:
        """The ratio, or its bound where one of the two did not fail."""
        low, high = self.interval
        if math.isnan(self.ratio):
            return "p_A / p_B not known"
        about, value = ("=", self.ratio) if self._has_ratio else ("below", high) if self.ratio == 0 else ("above", low)
        return f"p_A / p_B {about} {format_alike(value)[0]}"

    def __repr__(self) -> str:
        ends = " [{}, {}]".format(*format_alike(*self.interval)) if self._has_ratio else ""
        return f"<Comparison {self._ratio_text}{ends}, {self.n_sim:,} simulations>"

    def __str__(self) -> str:
        more = ("Details", say("next", command="comparison.details()", what=say("details")))
        return "\n".join(fold_rows([*list_ratio_facts(self), *list_warnings(self.all_warnings), more]))

    @property
    def all_warnings(self) -> tuple[str, ...]:
        """Warnings of the ratio, and of its error from a fitted base."""
        return (*self.warnings, *(() if self.base_uncertainty is None else self.base_uncertainty.warnings))

    def details(self) -> str:
        """Return the ratio and both probabilities with all intervals and warnings, in a text."""
        lines = [*fold_rows(list_ratio_facts(self), 1_000), *indent_lines(self.base_uncertainty)]
        covs = " and ".join("not known" if math.isinf(side.cov) else f"{side.cov:.2g}" for side in (self.a, self.b))
        lines.append(f"  c.o.v. {covs}; {self.n_sim:,} simulations, half of them of each")
        return "\n".join(lines + [f"  warning: {text}" for text in self.warnings])

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON; NaN and infinities become None."""
        names = ("ratio", "interval", "confidence", "both", "shares", "share_intervals", "n_sim", "warnings", "a", "b")
        data = {name: getattr(self, name) for name in (*names, "base_uncertainty")} | {"either": self.either.to_dict()}
        return cast(dict[str, Any], to_json_value(data))


def list_ratio_facts(
    found: Comparison, a: str = "A", b: str = "B", fails: str = "fails", model: str = "base distribution"
) -> list[Row]:
    """Return the ratio with its widest interval, what limits that, and p of each and of both, each in a sentence.

    `a` and `b` are the names of the two, `fails` the verb of a failure, `model` what x is drawn from.
    """
    base, own = found.base_uncertainty, found.interval
    ends, left_out = own if base is None else base.interval, ""
    if ends is None and base is not None:
        left_out = say("error not known", model=model, reason=base.reason.rstrip("."))
    known = None if left_out else base
    rows = list_ratio_rows(found.ratio, own, ends, found.confidence, found.n_sim, known, model, a, b, fails)
    exact = "" if base is None else say("with an exact model", model=model)
    labels = (name if len(name) < LABEL - 1 else letter for name, letter in ((a, "A"), (b, "B")))
    sides = [(name, _describe_side(side, exact)) for name, side in zip(labels, (found.a, found.b), strict=True)]
    rows += [("Left out", left_out), *sides]
    if found._has_ratio:
        both, first, second = format_sides([(side.p, side.interval) for side in found.parts.values()])
        rows.append(("Together", say("shares", both=both, a=a, first=first, b=b, second=second)))
    return [row for row in rows if row[1]]


def list_ratio_rows(
    ratio: float,
    own: Interval,
    ends: Interval | None,
    confidence: float,
    n_sim: int,
    base: BaseUncertainty | None,
    model: str,
    a: str,
    b: str,
    fails: str,
) -> list[Row]:
    """Return a ratio with its widest interval, `ends` (None if not known), and what limits that, in sentences.

    `own` is the interval if the model of x is exact, `base` its error; the rest as in `list_ratio_facts`.
    """
    about = {"a": a, "b": b, "fails": fails, "sure": f"{100 * confidence:g} %"}
    limit, (low, high) = say("limited by simulations", n=f"{n_sim:,}", few=""), ends or own
    if math.isnan(ratio):
        return [("Ratio", say("ratio not known", **about)), ("Limited by", limit)]
    value, least, most = format_alike(ratio if math.isfinite(ratio) else low, low, high)
    if ratio == 0 or (math.isinf(ratio) and low > 0):
        fact = "ratio of a safe one" if ratio == 0 else "ratio to a safe one"
    elif ends is None or high > UNLIMITED * low > 0 or (low <= 0 and math.isinf(high)):
        fact = "ratio without limits"
    elif low <= 0 or math.isinf(high):
        fact = "ratio below" if low <= 0 else "ratio above"
    else:
        fact = "ratio"
        limit = describe_limit(ratio, own, ends, f"{n_sim:,}", model, base)
    text = say(fact, ratio=value, low=least, high=most, **about)
    text += say("undecided which", fails=fails) if fact == "ratio" and low <= 1 <= high else ""
    return [("Ratio", text), ("Limited by", limit)]


def format_sides(sides: Sequence[tuple[float, Interval]]) -> list[str]:
    """Return probabilities or rates in one form; what no draw showed by its upper limit."""
    values = format_alike(*(p for p, _ in sides))
    limits = (format_alike(high)[0] for _, (_, high) in sides)
    return [v if p > 0 else f"below {high}" for (p, _), v, high in zip(sides, values, limits, strict=True)]


def _describe_side(side: Side, exact: str) -> str:
    """Return p of one of the two with its interval, which holds if the base is `exact`."""
    p, low, high = format_alike(side.p, *side.interval)
    if side.p == 0:
        return say("side without a failure", high=high, exact=exact)
    return say("side", p=p, odds=describe_odds(side.p), low=low, high=high, exact=exact)


register_stored(Comparison, Side)


class EitherFails:
    """The problem that fails where A or B does, f = min(f_A, f_B); it remembers which, and counts simulations."""

    def __init__(self, a: Problem, b: Problem, gamma: float) -> None:
        self.dim, self.base = int(a.dim), a.base
        self.given = ", ".join(dict.fromkeys(given for problem in (a, b) if (given := getattr(problem, "given", ""))))
        self.column_names = names_of_columns(a)
        self.plain_draws = min(int(getattr(problem, "plain_draws", 0)) for problem in (a, b))
        self.n_sim = 0
        self._problems, self._gamma = (a, b), gamma
        self._known: dict[bytes, tuple[float, float]] = {}

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Simulate the rows of x (n, d) with both; return the smaller outcome of each, shape (n,)."""
        f = np.stack([one_per_row(problem.evaluate(x), len(x)) for problem in self._problems])
        self.n_sim += 2 * len(x)
        least = np.asarray(f.min(axis=0))
        for row in np.flatnonzero(least <= self._gamma):
            self._known[x[row].tobytes()] = (float(f[0, row]), float(f[1, row]))
        return least

    def failing_parts(self, x: FloatArray) -> FloatArray:
        """Return 1 if A and if B fails at points x (k, d) that were simulated, 0 elsewhere, shape (2, k)."""
        return (self.recall(x) <= self._gamma).astype(np.float64)

    def recall(self, x: FloatArray) -> FloatArray:
        """Return f of A and of B at points x (k, d) that were simulated, inf where neither fails, shape (2, k)."""
        unknown = np.array([row.tobytes() not in self._known for row in x], dtype=bool)
        if unknown.any():  # mapped there and back in another batch, some coordinate differs by its last bit
            self.evaluate(x[unknown])
        return np.array([self._known.get(row.tobytes(), (math.inf,) * 2) for row in x]).reshape(-1, 2).T


def compare(
    a: Problem,
    b: Problem,
    method: Stepping | str = Auto(),  # noqa: B008  (frozen, so safe to share)
    gamma: float = RunArguments.gamma,
    seed: int | None = RunArguments.seed,
    max_sim: int | None = RunArguments.max_sim,
    confidence: float = RunArguments.confidence,
    progress: bool | Listener = False,
    *,
    ensemble_run: bool = True,
) -> Comparison:
    """Estimate P[f_A(X) <= gamma] / P[f_B(X) <= gamma] for two functions of the same X.

    The method estimates P[A or B fails], f = min(f_A, f_B), and both are simulated at every draw. With weights w_i and
    indicators a_i, b_i of the draws, p_A = sum w a and p_B = sum w b. The error of log(p_A / p_B) is that of sum w (a /
    p_A - b / p_B), to which draws where both fail contribute next to nothing. The more alike the two are, the smaller
    is the error of their ratio; the errors of two separate runs would add up. The interval is log-normal with the t
    quantile of the effective number of draws where only one of them fails; without such draws it follows from the
    Clopper-Pearson bound on their probability.

    If the base distribution has refits (`FittedBase`), both probabilities are also known under each refit, and so
    is the uncertainty of the ratio that the events leave (`Comparison.base_uncertainty`): as a rule several times
    smaller than that of either probability.

    If one fails hundreds of times less often than the other, few draws show it failing and the result has a warning:
    then estimate each separately.

    Args:
        a: Problem A: `dim`, `base`, `evaluate`.
        b: Problem B, with the same base distribution.
        method: One that gives weighted points (`Estimate.sample`), as all of `METHODS` do.
        gamma: Threshold of failure, for both.
        seed: Same seed, same answer.
        max_sim: Simulations of A and B together that are never exceeded.
        confidence: Nominal coverage of the intervals.
        progress: As in `estimate`.
        ensemble_run: As in `estimate`; the further run is one of both, and is made too where the failing points of A
            alone or of B alone do not reach the refits.

    Raises:
        ValueError: If an argument is not as described in `estimate`, or the base distributions differ.

    Example:
        >>> import samplers
        >>> a = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> b = samplers.FunctionProblem(lambda x: 3.2 - x[:, 0], dim=2)
        >>> print(f"{samplers.compare(a, b, seed=1, max_sim=8000).ratio:.1f}")  # Phi(-3) / Phi(-3.2) = 1.96
        2.0
    """
    if max_sim is not None:
        check_whole("max_sim (of A and B together)", max_sim, 2)
    for problem in (a, b):
        check_problem(problem, "dim", "base", "evaluate")
    if int(a.dim) != int(b.dim):
        raise ValueError(
            f"Expected two problems with the same x, got {a.dim} and {b.dim} dimensions: estimate each by itself."
        )
    x = a.base.sample(16, np.random.default_rng(0))
    if not np.allclose(a.base.log_prob(x), b.base.log_prob(x), rtol=1e-9, atol=1e-9):
        raise ValueError("Expected two problems with the same base distribution: estimate each alone.")
    problem = EitherFails(a, b, gamma)
    limit = None if max_sim is None else max_sim // 2
    either = estimate(
        problem, method, gamma, seed, limit, confidence=confidence, progress=progress, ensemble_run=ensemble_run
    )
    found = _summarise(either, problem.failing_parts, 0, problem.recall(either.failures.x))
    return replace(found, n_sim=problem.n_sim - (0 if either.ensemble_run is None else 2 * either.ensemble_run.n_sim))


def _summarise(either: Estimate, values: Callable[[FloatArray], FloatArray], n_sim: int, f: FloatArray) -> Comparison:
    """Return the comparison that values at the points of an estimate of P[A or B fails] give; 1 if A, if B fails."""
    sample = require_sample(either)
    fails = sample.f <= either.gamma
    weights, units = sample.weights[fails], sample.units[fails]
    found = np.asarray(values(sample.x), dtype=np.float64).reshape(2, -1)
    least = found.min(axis=0)
    sums = np.zeros((5, sample.n_units))
    for total, each in zip(sums, (*found, least, *(found - least)), strict=True):
        total += np.bincount(units, weights * each, sample.n_units)
    totals = sums[:2]
    # the error of the units as `_error` has it for A and B: for A = either, A has the c.o.v. of either
    own = _error(np.bincount(units, weights, sample.n_units).astype(np.float64))
    factor = cov_inflation(either, own / either.p if either.p > 0 else math.inf)
    single = has_independent_points(sample)
    most, missed = float(found.max(initial=0.0)), either.bound_missed(0.5 + either.confidence / 2)
    a, b = (_side(total, totals, factor, single, either, most, either.interval[1]) for total in totals)
    limits = [min(missed, side.interval[1]) for side in (a, b)]
    both, *alone = (
        _side(total, totals, factor, single, either, most, limit)
        for total, limit in zip(sums[2:], (min(limits), *limits), strict=True)
    )
    few = [
        f"{name} failed in {f'only {s.ess:.0f} effective draws' if s.ess else 'no draw'}"
        for name, s in (("A", a), ("B", b))
        if s.ess < 30  # its c.o.v. is about 0.2 or more
    ]
    about = [f"{' and '.join(few)}: {RATIO_COARSE}; estimate each separately."] if few else []
    for name, own, s in (("A", totals[0], a), ("B", totals[1], b)):
        above, where = _find_missed(own, totals, either)
        if above > UNRESOLVED_SHARE * s.p > 0:
            about.append(
                f"{name} may fail more often by up to {above:.1e} in {' and '.join(where)}: too few failures found."
            )
    interval = _ratio_interval(totals, factor, single, either)
    return Comparison(
        ratio=_ratio(a.p, b.p),
        interval=interval,
        confidence=either.confidence,
        a=a,
        b=b,
        parts={"both": both, "only_a": alone[0], "only_b": alone[1]},
        n_sim=n_sim,
        warnings=(*either.warnings, *about),
        either=either,
        f=f,
        base_uncertainty=_base_uncertainty(totals, factor, either, values, interval),
    )


def _base_uncertainty(
    totals: FloatArray,
    factor: float,
    either: Estimate,
    values: Callable[[FloatArray], FloatArray],
    sampling: Interval,
) -> BaseUncertainty | None:
    """Return the uncertainty that the events leave from the unit totals of A and B, shape (2, n_units).

    It holds the interval of the sampling, which of few draws is wider than their errors say.
    """
    fitted = find_fitted_base(either.base)
    if fitted is None:
        return None
    p_a, p_b = (float(p) for p in totals.sum(axis=1))

    def compute_sums() -> RefitSums:
        if p_a == 0 or p_b == 0:
            raise ValueError("A or B never failed.")
        return reweight_runs_to_refits(either, fitted.refits, lambda run: values(require_sample(run).x))

    cov = factor * _error(totals[0] / p_a - totals[1] / p_b) if p_a > 0 and p_b > 0 else math.inf
    about: dict[str, Any] = {"n_sim": 0 if either.ensemble_run is None else 2 * either.ensemble_run.n_sim}
    about |= {"sampling": sampling, "is_ratio": True}
    return summarise_refits(_ratio(p_a, p_b), cov, either.confidence, fitted, compute_sums, **about)


def _ratio(a: float, b: float) -> float:
    """Return a / b; inf if b alone is 0, NaN if both are."""
    if b > 0:
        return a / b
    return math.inf if a > 0 else math.nan


def _find_missed(own: FloatArray, totals: FloatArray, either: Estimate) -> tuple[float, list[str]]:
    """Return `find_missed` of the unit totals of A or of B, (n_units,) of (2, n_units)."""
    return find_missed(either.parts, np.arange(len(own)), totals.max(axis=0), own, either.confidence)


def _side(
    own: FloatArray, totals: FloatArray, factor: float, single: bool, either: Estimate, most: float, limit: float
) -> Side:
    """Return what unit totals (n_units,) add up to, of those of A and B (2, n_units), whose values are `most` at most.

    `limit` is the upper one of a sum that is 0.
    """
    p, ess = float(own.sum()), effective_number(own)
    if p == 0:
        return Side(p=0.0, interval=(0.0, limit), cov=math.inf, ess=0.0)
    cov = factor * _error(own) / p
    low, high = interval_of_sum(p, cov, ess, single, either.confidence)
    high = min(1.0, p + math.hypot(high - p, most * _find_missed(own, totals, either)[0]))
    return Side(p=p, interval=(low, high), cov=cov, ess=ess)


def _ratio_interval(totals: FloatArray, factor: float, single: bool, either: Estimate) -> Interval:
    """Return the interval of the ratio from the unit totals of A and B, shape (2, n_units)."""
    p_a, p_b = totals.sum(axis=1)
    if p_a == 0 and p_b == 0:
        return 0.0, math.inf
    apart = totals[0] != totals[1]  # units that tell the two from one another
    if p_a == 0 or p_b == 0 or not apart.any():
        # none of `ess` effective draws was of the kind that is missing: its share is at most
        share = bound_missed([(1.0, max(round(effective_number(totals.max(axis=0))), 1))], either.confidence)
        if either.parts:
            share = _find_missed(np.zeros_like(totals[0]), totals, either)[0] / max(p_a, p_b)
            share = share if min(p_a, p_b) == 0 else min(share, 1 - 1e-9)
        if p_a == 0:
            return 0.0, share
        return (1 / share, math.inf) if p_b == 0 else (1 - share, 1 / (1 - share))
    z = totals[0] / p_a - totals[1] / p_b
    spread, ratio = factor * _error(z), float(p_a / p_b)
    ess = effective_number(np.where(apart, np.abs(z), 0.0))
    quantile = float(stdtrit(degrees_of_freedom(ess, single), 0.5 + either.confidence / 2))
    up_a, up_b = (
        math.log1p(_find_missed(own, totals, either)[0] / p) for own, p in zip(totals, (p_a, p_b), strict=True)
    )
    low, high = (min(math.hypot(quantile * spread, up), MAX_LOG) for up in (up_b, up_a))
    return ratio * math.exp(-low), ratio * math.exp(high)


def _error(totals: FloatArray) -> float:
    """Return the standard error of a sum of unit totals (n,), the largest counted once more, as in `weighted_cov`."""
    n = len(totals)
    square = float(((totals - totals.mean()) ** 2).sum()) * n / max(n - 1, 1)
    return math.sqrt(square + float(np.abs(totals).max()) ** 2)
