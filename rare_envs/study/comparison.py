"""Comparison of two egos in the same draws of one scenario, by crashes and by their severity; and rates of several.

The run estimates P[A or B crashes]. Its failures are driven again by both egos for delta-v, injuries and kinds of
crash, which are other sums over the same draws. Rates of scenarios are added as in `rare_envs.exposure`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import samplers
from rare_envs import exposure
from rare_envs.distributions.events import EventFrequency
from rare_envs.files import format_json, replace_text
from rare_envs.people import COUNTED, HumanBenchmark, add_people, people_in
from rare_envs.plugins import EgoGone, one_line
from rare_envs.problem import DrivingProblem
from rare_envs.startup import __version__
from rare_envs.study import arguments, text, writing
from rare_envs.study.arguments import BadInput, Question, RunInterrupted, as_bad_input
from rare_envs.study.evaluate import RowKeeper, make_evaluator, recheck, settle_chunk, use_batches_of
from rare_envs.study.failures import MAX_REPLAYED, VARIES, measure_severity
from rare_envs.study.question import Study, note_question, open_question, prepare, split_question
from rare_envs.study.report import explain_other_events, fold_spread
from rare_envs.study.run_folder import BLOCKS, COMPARISON, FAILURES, SIDES
from rare_envs.traffic.crash import CRASH_KINDS, NONE, OTHERS
from samplers.comparison import Comparison, Side, format_sides
from samplers.evaluate import Evaluator, Executor
from samplers.problem import FloatArray
from samplers.workers import ExecutorError

UNUSED_FIELDS = ("target_cov", "replicates", "on_error", "sensitivity", "max_p", "max_rate")
"""Fields of a question that a comparison does not use."""
INJURIES = "serious_injuries"
"""Name of injuries of MAIS 3 or more."""
DELTA_V = {f"delta_v_above_{v}": float(v) for v in (2, 5, 10)}
"""Names of crashes with a larger delta-v [m/s]."""


class Severity(NamedTuple):
    """What the crashes of a comparison are like; nothing but the reason where that is not known."""

    outcomes: Mapping[str, Comparison]
    """Serious injuries, and crashes with a larger delta-v, by `INJURIES` and `DELTA_V`."""
    kinds: Mapping[str, tuple[float, float]]
    """P[A ends in a crash of a kind], and P[it does and B does not crash], by kind, the most frequent first."""
    unknown: str = ""
    """Why it is not known."""


class ComparedEgos(NamedTuple):
    """Two egos compared in a scenario."""

    found: Comparison
    severity: Severity
    answer: dict[str, Any]
    """Values for JSON."""


def weigh_crashes(found: Comparison, problems: Sequence[DrivingProblem]) -> Severity:
    """Drive the failures of A or B again by both egos, and compare how severe their crashes are."""
    if any(problem.varies for problem in problems):
        return Severity({}, {}, VARIES)
    known: dict[bytes, tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = {}

    def drive(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return how often a point counts, delta-v, injuries and kind of both egos, shape (k,) and (2, k)."""
        step = math.ceil(len(x) / MAX_REPLAYED) or 1  # of very many some, evenly spaced, stand for all
        if (key := x.tobytes()) not in known:
            counts, (delta_v, injuries, kinds) = np.zeros(len(x)), np.zeros((3, 2, len(x)))
            counts[::step] = step
            for side, problem in enumerate(problems):
                crash = problem.crashes(x[::step])
                delta_v[side, ::step], injuries[side, ::step] = measure_severity(crash, False)
                kinds[side, ::step] = crash.kind.numpy()
            known[key] = counts, delta_v, injuries, kinds
        return known[key]

    def count(x: FloatArray, above: float | None) -> FloatArray:
        counts, delta_v, injuries, _ = drive(x)
        return counts * (injuries if above is None else delta_v > above)

    try:
        limits = {INJURIES: None, **DELTA_V}
        outcomes = {name: found.weigh(partial(count, above=above)) for name, above in limits.items()}
        sample = found.either.sample
        assert sample is not None  # or there would be no comparison
        counts, _, _, (kinds, of_b) = drive(sample.x)
    except (Exception, SystemExit, EgoGone) as error:  # the egos are the user's, and need not do again what they did
        return Severity({}, {}, one_line(error))
    weights, shares = counts * sample.weights[sample.f <= found.either.gamma], dict[str, tuple[float, float]]()
    avoids = np.isin(of_b, (NONE, OTHERS))
    for kind in set(np.unique(kinds).astype(int).tolist()) - {NONE, OTHERS}:
        mine = weights * (kinds == kind)
        shares[CRASH_KINDS[kind]] = float(mine.sum()), float(mine @ avoids)
    return Severity(outcomes, dict(sorted(shares.items(), key=lambda share: -share[1][0])))


def compare_egos(
    question: Question,
    ego_b: str,
    progress: bool = False,
    out: Path | None = None,
    force: bool = False,
    algo_b: str | None = None,
    stats_b: str | None = None,
    executor: Executor | None = None,
    whole: Mapping[str, Any] | None = None,
) -> ComparedEgos:
    """Estimate p_A / p_B, see `samplers.compare`; some simulations of each are done again at the end.

    A part of a sum, whose name and arguments are `whole`, is continued, and keeps its journals.
    """
    questions = {"A": question, "B": replace(question, ego=ego_b, algo=algo_b, stats=stats_b)}
    studies = {name: prepare(each) for name, each in questions.items()}
    return _compare(studies, progress, out, force, executor, whole)


def resume_comparison(
    folder: Path, questions: Mapping[str, Question], trust: bool = False, executor: Executor | None = None
) -> ComparedEgos:
    """Continue an interrupted comparison of two questions; the answer is that of an undisturbed one."""
    opened = {
        name: open_question(asdict(each), folder, trust, core=each.core, device=each.device)
        for name, each in questions.items()
    }
    return _compare({name: prepare(each) for name, each in opened.items()}, True, folder, False, executor)


def _compare(
    studies: dict[str, Study],
    progress: bool,
    out: Path | None,
    force: bool,
    executor: Executor | None,
    whole: Mapping[str, Any] | None = None,
) -> ComparedEgos:
    """Compare the egos A and B of two studies of the same scenarios."""
    studies = {name: settle_chunk(study, executor is not None) for name, study in studies.items()}
    dims = [study.problem.dim for study in studies.values()]
    if dims[0] != dims[1]:  # of the egos that are shipped, human and noisy:EGO
        raise BadInput(
            f"Expected two egos with the same x, got {dims[0]} and {dims[1]} dimensions, as an ego that is "
            "random has its own in x: estimate each by itself."
        )
    question = studies["A"].question
    questions = {name: study.question for name, study in studies.items()}
    with (
        writing.journals_of(
            whole or {"command": "compare"}, out, questions, force, COMPARISON, FAILURES, BLOCKS
        ) as journals,
        contextlib.ExitStack() as stack,
    ):
        kept, evaluators = dict[str, RowKeeper](), dict[str, Evaluator]()
        for name, journal in zip([*studies], journals, strict=True):
            studies[name] = use_batches_of(journal, studies[name])
            evaluators[name] = make_evaluator(studies[name], journal, executor)
            kept[name] = RowKeeper(question.gamma)
            evaluators[name].watchers.append(kept[name].keep)
        try:
            with as_bad_input(ValueError, EgoGone, ExecutorError):
                for evaluator in evaluators.values():
                    stack.enter_context(evaluator)
                asked = question.run_arguments
                found = samplers.compare(
                    evaluators["A"],
                    evaluators["B"],
                    studies["A"].method,
                    asked.gamma,
                    asked.seed,
                    asked.max_sim,
                    asked.confidence,
                    progress,
                    ensemble_run=question.ensemble_run,
                )
        except samplers.EstimationInterrupted as stopped:
            raise RunInterrupted(arguments.describe_stop(stopped.estimate, "P[A or B fails]")) from None
        except KeyboardInterrupt:
            raise RunInterrupted(arguments.FIRST_BATCH) from None
        checks = {name: recheck(study, kept[name]) for name, study in studies.items()}
        doubts = [f"{name}: {check.warning}" for name, check in checks.items() if check is not None and check.warning]
        found = replace(found, warnings=(*found.warnings, *doubts))
        crashes = not explain_other_events(question)
        severity = weigh_crashes(found, [each.problem for each in studies.values()]) if crashes else Severity({}, {})
        pair = ComparedEgos(found, severity, _describe_pair(found, severity, studies))
        if out is not None:
            for recorded in split_question(pair.answer["question"]):
                note_question(arguments.read_question(recorded))
            with writing.unwritten_results(out, pair):
                replace_text(out / COMPARISON, format_json(pair.answer) + "\n")
                failures, space = found.either.failures, studies["A"].problem.space
                f = np.where(np.isfinite(found.f), found.f, np.nan)
                writing.write_failures(out, space, failures, others=dict(zip(SIDES, f, strict=True)))
    return pair


def _describe_pair(found: Comparison, severity: Severity, studies: Mapping[str, Study]) -> dict[str, Any]:
    """Return a comparison, what was asked and the verdict on its limit, as plain values for JSON."""
    a, b = (study.question for study in studies.values())
    inputs = {key: value for key, value in asdict(a).items() if key not in UNUSED_FIELDS}
    verdict = None if a.max_ratio is None else found.meets(a.max_ratio, a.assume_traffic)
    notes = [f"{name}: {note}" for name, study in studies.items() for note in study.problem.notes]
    notes += [f"severity is not known: {severity.unknown}"] if severity.unknown else []
    return {
        **found.to_dict(),
        "severity": {name: list_numbers(each) for name, each in severity.outcomes.items()},
        "kinds_of_a": list_kinds(severity.kinds, "p"),
        "question": {"ego_a": inputs.pop("ego"), "ego_b": b.ego, **inputs, "algo_b": b.algo, "stats_b": b.stats},
        "gate": None if verdict is None else verdict.to_dict(),
        "notes": notes,
        "text": [
            *text.describe_comparison(found, a, b.ego, severity.kinds),
            *(f"note: {note}" for note in notes),
        ],
        "version": __version__,
    }


def list_numbers(found: Comparison) -> dict[str, Any]:
    """Return a comparison as plain values, without the estimate behind it."""
    return {name: value for name, value in found.to_dict().items() if name not in ("either", "warnings", "n_sim")}


def list_kinds(kinds: Mapping[str, tuple[float, float]], name: str) -> dict[str, dict[str, float]]:
    """Return kinds of crash of A as plain values: how often, and the share of them that B avoids."""
    return {kind: {name: all_, "avoided_by_b": avoided / all_} for kind, (all_, avoided) in kinds.items() if all_ > 0}


LEAST = 1e-300
"""Floor of a ratio whose logarithm is taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RateComparison:
    """Rates of two egos per million km in the same draws of several scenarios, and the ratio of their sums."""

    scenarios: Mapping[str, Comparison]
    """The comparison in each scenario, by name."""
    frequencies: Mapping[str, EventFrequency]
    """How often the events of each scenario happen."""

    @cached_property
    def rates(self) -> dict[str, exposure.TotalRate]:
        """Rates per million km: of A, of B, and by which egos have them in the same draws."""
        sides = {name: {"a": pair.a, "b": pair.b, **pair.parts} for name, pair in self.scenarios.items()}
        return {
            each: exposure.TotalRate(tuple(self._rate(name, known[each]) for name, known in sides.items()))
            for each in next(iter(sides.values()))
        }

    def _rate(self, name: str, side: Side, exact: bool = False) -> exposure.CollisionRate:
        """Return the rate of one ego, or of both, in a scenario, with the error of the traffic model unless `exact`."""
        pair, (low, high) = self.scenarios[name], side.interval
        fold, spread = fold_spread(None if exact else pair.either.base_uncertainty)
        of_traffic = exposure.normal_quantile(pair.confidence) * spread
        if side.p > 0:
            below, above = (
                math.exp(math.hypot(fold * math.log(far), of_traffic))
                for far in (side.p / max(low, LEAST), high / side.p)
            )
            low, high = side.p / below, side.p * above
        else:
            if (pair.a.p > 0) != (pair.b.p > 0):  # the ratio says how rare the failures of the other are
                least, most = pair.interval
                high = min(high, pair.a.p / max(least, LEAST) if pair.a.p > 0 else pair.b.p * most)
            high *= math.exp(of_traffic)
        return exposure.CollisionRate(
            scenario=name,
            frequency=self.frequencies[name],
            p=side.p,
            sampling_log_sd=fold * side.cov if side.p > 0 else 0.0,
            base_log_sd=spread,
            interval=(low, min(high, 1.0)),
            confidence=pair.confidence,
        )

    @property
    def per_million_km(self) -> dict[str, float]:
        """The values of `rates`."""
        return {name: rate.per_million_km for name, rate in self.rates.items()}

    @property
    def shares(self) -> dict[str, float]:
        """Of all events of the scenarios: in which both have it, only A, only B, and neither."""
        events = exposure.MILLION_KM * sum(self.frequencies[name].per_km for name in self.scenarios)
        shares = {name: rate / events for name, rate in self.per_million_km.items() if name not in ("a", "b")}
        return {**shares, "neither": 1.0 - sum(shares.values())}

    @property
    def ratio(self) -> float:
        """Rate of A over that of B; inf if B has none, NaN if neither has."""
        a, b = self.per_million_km["a"], self.per_million_km["b"]
        return a / b if b > 0 else math.inf if a > 0 else math.nan

    @property
    def confidence(self) -> float:
        """Nominal coverage of the intervals."""
        return next(iter(self.scenarios.values())).confidence

    @cached_property
    def interval(self) -> tuple[float, float]:
        """Interval of the ratio with the errors of the traffic models."""
        return self._find_interval(exact=False)

    @cached_property
    def interval_if_exact(self) -> tuple[float, float]:
        """Interval of the ratio if the traffic models are exact."""
        return self._find_interval(exact=True)

    def _draw(self, exact: bool) -> FloatArray:
        """Return draws of the sums of A and of B per million km, the least and the most of each, (2, 2, n).

        From draws of B's rate in each scenario and of the ratio there, by its interval, with the traffic model or if
        that is `exact`. An ego without a failure in a scenario has 0 there for one limit, and its upper one for the
        other.
        """
        rng, n = np.random.default_rng(0), exposure.RATE_DRAWS
        ends = np.zeros((2, 2, n))
        for name, pair in self.scenarios.items():
            known = None if exact else pair.base_uncertainty
            low, high = pair.interval if known is None or known.interval is None else known.interval
            a, b = (self._rate(name, side, exact).draw(rng.standard_normal(n), rng) for side in (pair.a, pair.b))
            if pair.a.p > 0 and pair.b.p > 0:
                error = rng.standard_normal(n) / exposure.normal_quantile(pair.confidence)
                away = np.where(error < 0, math.log(pair.ratio / max(low, LEAST)), math.log(high / pair.ratio))
                a = b * pair.ratio * np.exp(away * error)
            elif pair.a.p > 0:
                b = a / max(low, LEAST)
            elif pair.b.p > 0:
                a = b * high
            ends += np.stack([(a if pair.a.p > 0 else 0.0 * a, a), (b if pair.b.p > 0 else 0.0 * b, b)])
        return ends

    def _find_interval(self, exact: bool) -> tuple[float, float]:
        """Return the interval of the ratio."""
        ends, tails = self._draw(exact), exposure.tail_levels(self.confidence)
        if not ends[:, 0].any():
            return 0.0, math.inf
        with np.errstate(divide="ignore", invalid="ignore"):
            least, most = ends[0, 0] / ends[1, 1], np.where(ends[1, 0] > 0, ends[0, 1] / ends[1, 0], math.inf)
        return float(np.quantile(least, tails[0])), float(np.quantile(most, tails[1], method="inverted_cdf"))

    @property
    def left_out(self) -> str:
        """Why the error of a traffic model is not in the interval; empty if it is."""
        for name, pair in self.scenarios.items():
            known, either = pair.base_uncertainty, pair.either.base_uncertainty
            if known is not None and known.interval is None:
                return f"{text.name_scenario(name)}: {known.reason.rstrip('.')}"
            if either is not None and not math.isfinite(either.spread):
                return f"{text.name_scenario(name)}: {either.reason.rstrip('.')}"
        return ""

    def count_people(self, *outcomes: str) -> HumanBenchmark | None:
        """Return what people had of outcomes in the same events together; None if it was not counted in one kind."""
        kinds: list[str] = []
        for name, pair in self.scenarios.items():
            kinds += [part.name for part in pair.either.parts if part.name in COUNTED] or [name]
        known = [getattr(people_in(k), each) if k in COUNTED else None for k in kinds for each in outcomes]  # type: ignore[arg-type]
        return add_people(known)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about the ratios and about the errors of their traffic models, by scenario."""
        return self._name(lambda pair: pair.all_warnings)

    def _name(self, find: Callable[[Comparison], Sequence[str]]) -> tuple[str, ...]:
        """Return texts about the scenarios, each behind the name of its own."""
        return tuple(
            f"{text.name_scenario(name)}: {each}" for name, pair in self.scenarios.items() for each in find(pair)
        )

    def tabulate(self, label: str, people: HumanBenchmark | None) -> tuple[str, ...]:
        """Return a row of the table of outcomes: rates of A and B, their ratio, both, only A, only B, and people."""
        said = text.format_ratio(self.ratio, self.interval)
        rates = format_sides([(rate.per_million_km, rate.interval_per_million_km) for rate in self.rates.values()])
        return (label, *rates[:2], said, *rates[2:], text.format_rate(people.per_million_km) if people else "")

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinities and NaN become None."""
        low, high, ratio = (end if math.isfinite(end) else None for end in (*self.interval, self.ratio))
        return {
            "ratio": ratio,
            "interval": [low, high],
            "confidence": self.confidence,
            "per_million_km": self.per_million_km,
            "intervals_per_million_km": {name: [*rate.interval_per_million_km] for name, rate in self.rates.items()},
            "shares": self.shares,
            "warnings": [*self.warnings],
        }
