"""Risk: collisions of an ego per million km over scenarios that count nothing twice."""

from __future__ import annotations

import contextlib
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

import agents
import samplers
from rare_envs import exposure
from rare_envs.distributions.events import EventFrequency
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.files import format_json, replace_text
from rare_envs.people import HumanBenchmark
from rare_envs.plugins import did_you_mean
from rare_envs.scenarios.base import Scenario, load_base
from rare_envs.scenarios.registry import env_id_of, find_scenario, split_layout
from rare_envs.startup import __version__
from rare_envs.study import text
from rare_envs.study.arguments import Question, RunInterrupted, as_bad_input, keep_answer, output_folder
from rare_envs.study.evaluate import compare_egos, run, run_into
from rare_envs.study.events import COUNTED, EventRate, add_people, count_people, sum_people
from rare_envs.study.plots import save_risk_plot
from rare_envs.study.question import CHANGEABLE, Study, build_problem, open_question, prepare
from rare_envs.study.report import MODEL_NOUN, Report, find_frequency, fold_spread, judge_rate
from rare_envs.study.run_folder import COMPARISON, FAILURES, JOURNAL, RISK
from rare_envs.study.writing import SUM, check_no_results, clear_runs, unwritten_results
from samplers.analysis.gate import find_doubt, judge_ends
from samplers.comparison import RATIO_COARSE, Side, format_shares
from samplers.evaluate import Executor
from samplers.output import LABEL, MOST_LINES, WIDTH, Row, fold_rows, format_alike, say
from samplers.problem import FloatArray
from samplers.result import describe_limit, list_warnings

SCENARIO_SET = ("cut_in", "hard_brake")
"""Scenarios that count nothing twice."""
PICTURE = "risk.png"
"""Picture of the numbers of a risk, whose file is the last one that is written."""
TWICE = ("cut_in", "car_following")
"""Scenarios of which a set may have one: a cut-in gives the ego a new leader, so that car-following behind new leaders
contains the cut-ins."""


def _load_fitted(scenario: Scenario, name: str) -> FittedDistribution | None:
    """Return a base that was fitted to events; None if it was assembled otherwise."""
    base = load_base(scenario, name)
    return base if isinstance(base, FittedDistribution) else None


def list_sites(scenario: Scenario) -> dict[str, str]:
    """Return the sites of a scenario: the name of the first base of each, and the site in words."""
    found: dict[str, str] = {}
    for name in scenario.bases:
        base = _load_fitted(scenario, name)
        site = "" if base is None else exposure.read_site(base.record)
        if site and site not in found.values():
            found[name] = site
    return found


def choose_base(scenario: Scenario, given: str | PathLike[str] | None, site: str) -> str:
    """Return the traffic model of a scenario at a site, or the one that is given."""
    if given is not None:
        return str(given)
    sites = list_sites(scenario)
    if site not in sites:
        raise ValueError(
            f"{scenario.name} has no base of the site {site!r} (it has {', '.join(sites) or 'none'}): "
            f"--base {scenario.name}={scenario.default_base} takes another one."
        )
    return site


def compare_sites(
    report: Report, sites: Sequence[str], progress: bool = False, executor: Executor | None = None
) -> dict[str, float]:
    """Return rates per km at other sites over that of a report, by name."""
    study, factors = report.study, dict[str, float]()
    if report.estimate.p == 0 or report.rate is None:
        return factors
    scenario, own = study.problem.world.scenario, study.fitted
    for name, site in list_sites(scenario).items():
        base = _load_fitted(scenario, name)
        if base is None or base.frequency is None or (own is not None and site == exposure.read_site(own.record)):
            continue
        other = study.under(name)
        try:
            p = report.estimate.reweight(other.problem.base).p
        except ValueError:
            p = run(other, progress, executor=executor).estimate.p if name in sites else math.nan
        if p > 0:
            factors[name] = p * base.frequency.per_km / report.rate.per_million_km * exposure.MILLION_KM
    return factors


@dataclass(frozen=True, eq=False, kw_only=True)
class ScenarioRisk:
    """One scenario of a risk."""

    report: Report
    """Its evaluation."""
    rate: exposure.CollisionRate
    """Its collisions per million km."""
    site_factors: Mapping[str, float]
    """Rates under the bases of other sites over that under its own, by name, as far as they are known."""

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.rate.scenario

    @property
    def kinds(self) -> dict[str, float]:
        """Collisions per million km by kind of crash; empty where it is not known."""
        scale = self.rate.frequency.per_km * exposure.MILLION_KM
        return {kind: scale * share.p for kind, share in self.report.kinds.shares.items()}

    def describe_traffic(self) -> str:
        """Return the base, the events behind it, and the rates under those of other sites."""
        study = self.report.study
        behind = "events not known" if study.fitted is None else study.fitted.fitted_to
        version = study.question.env_id.rpartition("/")[2]  # whose bases may have the same names
        factors = {name: factor for name, factor in self.site_factors.items() if factor > 0}
        sites = "".join(f", under {name} {factor:.2g} times as much" for name, factor in factors.items())
        return f"{study.base_name} of {version} ({behind}){sites}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        fitted = self.report.study.fitted
        return {
            **self.rate.to_dict(),
            "by_event": [each.to_dict() for each in self.report.events],
            "base": self.report.study.base_name,
            "events": None if fitted is None else fitted.events.used[0],
            "site_factors": dict(self.site_factors),
            "kinds_per_million_km": self.kinds,
            "report": text.report_as_json(self.report),
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Risk:
    """Collisions of an ego per million km, with what their uncertainty comes from."""

    ego: str
    """The ego, as it was named."""
    scenarios: tuple[ScenarioRisk, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Why the ego does not fit other scenarios, by name."""

    @cached_property
    def total(self) -> exposure.TotalRate:
        """Sum over the scenarios."""
        return exposure.TotalRate(tuple(each.rate for each in self.scenarios))

    @cached_property
    def injuries(self) -> exposure.TotalRate | None:
        """Serious injuries (MAIS 3 or more), summed over the scenarios with collisions; None if there are none."""
        found = [(each.report.injury_rate, each.rate.site_log_sd) for each in self.scenarios]
        rates = tuple(replace(rate, site_log_sd=spread) for rate, spread in found if rate is not None)
        return exposure.TotalRate(rates) if rates else None

    @property
    def kinds(self) -> dict[str, float]:
        """Collisions per million km by kind of crash, the most frequent first."""
        sums: dict[str, float] = {}
        for kind, rate in (part for each in self.scenarios for part in each.kinds.items()):
            sums[kind] = sums.get(kind, 0.0) + rate
        return dict(sorted(sums.items(), key=lambda kind: -kind[1]))

    @property
    def events(self) -> tuple[EventRate, ...]:
        """Rates by kind of event, each beside people and the human driver model in it."""
        return tuple(each for scenario in self.scenarios for each in scenario.report.events)

    @property
    def people(self) -> HumanBenchmark | None:
        """Contacts of people in the same events together; None if those of one kind were not counted."""
        return sum_people(self.events)

    @cached_property
    def verdict(self) -> samplers.analysis.Verdict | None:
        """Whether the sum is below the limit of the question; None without a limit."""
        limit = self.scenarios[0].report.study.question.max_rate
        if limit is None:
            return None
        missing = [f"{text.name_scenario(name)} is left out" for name in self.left_out]
        reason = next(filter(None, [*missing, *(each.report.indecision for each in self.scenarios)]), "")

        def judge(assume_traffic: bool) -> samplers.analysis.Verdict:
            found = [(each.report.find_judged_rate(assume_traffic), each.rate.site_log_sd) for each in self.scenarios]
            rates = tuple(replace(rate, site_log_sd=spread) for rate, spread in found)
            return judge_rate(limit, exposure.TotalRate(rates), reason)

        assumed = self.scenarios[0].report.study.question.assume_traffic
        return replace(judge(assumed), if_exact=None if assumed else judge(True).decision)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about p and about the error of its traffic model, by scenario."""
        named = ((text.name_scenario(each.name), each.report.warnings) for each in self.scenarios)
        left_out = (f"{text.name_scenario(name)} is left out: {why}" for name, why in self.left_out.items())
        return (*left_out, *(f"{name}: {warning}" for name, warnings in named for warning in warnings))

    @property
    def notes(self) -> tuple[str, ...]:
        """What the rates leave out, and what made no difference, by scenario."""
        return tuple(
            f"{text.name_scenario(each.name)}: {note}" for each in self.scenarios for note in each.report.notes
        )

    def __str__(self) -> str:
        """Return the answer, for people: the rate, a table by event, what limits it, and last the verdict."""
        return "\n".join(self.describe())

    def describe(self, last: Sequence[Row] = (), most: int = MOST_LINES) -> list[str]:
        """Return the lines of the answer, at most so many beside the table; `last` are facts before the verdict."""
        total, kinds, counted = self.total, self.kinds, self.people
        level, whole = f"{100 * total.confidence:g} %: ", sum(kinds.values())
        per_km = text.format_with_interval(total.per_million_km, total.interval_per_million_km, "", level)
        beside = "" if counted is None else f"; people {text.describe_people(counted)}"
        parts = (f"{text.format_share(r / whole)} {text.describe_kind(kind)}" for kind, r in kinds.items() if whole)
        rows = {
            "Limited by": text.describe_uncertainty(total),
            "Calibration": text.describe_calibrations(self.events),
            "Crashes": ", ".join(parts),
            "Injuries": "" if self.injuries is None else text.describe_injuries(self.injuries),
        }
        facts = [*(row for row in rows.items() if row[1]), *list_warnings(self.warnings), *last]
        gate, table = text.list_gate(self.verdict), text.tabulate_events(self.events, total)
        title = f"{self.ego}: collisions per million km {per_km}{beside}"
        return [*textwrap.wrap(title, WIDTH), *table, *fold_rows(facts, most - 1 - len(table) - len(gate)), *gate]

    def details(self) -> str:
        """Return the traffic behind each scenario, what the columns are, and all notes and warnings."""
        lines = [f"traffic      {'; '.join(each.describe_traffic() for each in self.scenarios)}"]
        lines += [f"human model  {text.describe_columns()}"]
        return "\n".join(
            [*lines, *(f"note: {each}" for each in self.notes), *(f"warning: {each}" for each in self.warnings)]
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "ego": self.ego,
            **self.total.to_dict(),
            "scenarios": {each.name: each.to_dict() for each in self.scenarios},
            "kinds_per_million_km": self.kinds,
            "injuries": None if self.injuries is None else self.injuries.to_dict(),
            "events": [each.to_dict() for each in self.events],
            "people": None if self.people is None else self.people.to_dict(),
            "gate": None if self.verdict is None else self.verdict.to_dict(),
            "left_out": dict(self.left_out),
            "doubtful": bool(self.warnings),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
            "text": self.describe(most=text.WHOLE),
            "version": __version__,
        }

    def save_plot(self, path: str | PathLike[str]) -> None:
        """Draw the rates by event with their intervals beside those of people, and save them as a .png."""
        save_risk_plot(Path(path), self.ego, self.total, self.events, self.people)


def risk(
    ego: Any,
    *,
    scenarios: Sequence[str] = SCENARIO_SET,
    sites: str | Sequence[str] = ("us101",),
    bases: Mapping[str, str | PathLike[str]] | None = None,
    out: str | PathLike[str] | None = None,
    progress: bool = False,
    force: bool = False,
    executor: Executor | None = None,
    **options: Any,
) -> Risk:
    """Estimate the collisions of an ego per million km, with an interval that includes what is not known of traffic.

    Each scenario's p is multiplied by the frequency of its events, and the products are added. The interval includes
    the errors of the counted events, of the fitted traffic models and of the simulations; with several `sites` also
    the spread between them. All is so for an ego that takes over at the moment of each event. A policy whose
    observations or actions do not fit one of the scenarios is evaluated in the others, with a warning.

    Args:
        ego: Its name, file or address, as for `agents.load_ego`; or an object, as for `DrivingProblem`.
        scenarios: Names of scenarios that count nothing twice; car_following may stand in place of cut_in.
        sites: Names of sites, each that of the first base fitted to events of it, such as "us101": the bases of the
            first are used, and the spread of the rate between it and the others is part of the interval. Each
            scenario must have a base of the first site, or one in `bases`.
        bases: Traffic models, names or JSON files, by scenario, in place of those of the first site.
        out: Folder for the picture, the numbers and a folder of each scenario. After an interruption the same call,
            or `resume_risk`, continues with the simulations that it has, unless the ego is an object.
        progress: Show a bar on standard error.
        force: Replace runs that the folder has, finished or not.
        executor: Where simulations are made, as in `rare_envs.study.run`.
        **options: Further fields of `rare_envs.study.Question`: seed, max_sim (of each scenario), method, max_rate (a
            limit of the sum, see `Risk.verdict`) and so on.

    Raises:
        BadInput: An argument cannot be used; a scenario has no frequency of its events; or the ego failed.
        RunInterrupted: It was interrupted; the message says what is known.

    Example:
        Leads that brake hard, with so few simulations that there is an upper limit alone:

        >>> import rare_envs
        >>> found = rare_envs.risk("idm", scenarios="hard_brake", method="mc", max_sim=300, seed=0)
        >>> found.total.per_million_km, round(found.total.interval_per_million_km[1], -3)
        (0.0, 23000.0)
    """
    sites = [sites] if isinstance(sites, str) else [*sites]
    scenarios = [scenarios] if isinstance(scenarios, str) else [*scenarios]
    whole: dict[str, Any] = {
        "command": "risk",
        "ego": ego if isinstance(ego, str) else "",
        "scenarios": scenarios,
        "sites": sites,
    }
    whole |= {"bases": {name: str(base) for name, base in (bases or {}).items()}, "chunked": executor is not None}
    whole |= {"options": {name: value for name, value in options.items() if name not in CHANGEABLE}}
    return _risk(ego, whole, bases or {}, None if out is None else Path(out), progress, force, executor, options)


def resume_risk(folder: Path, questions: Mapping[str, Question], whole: Mapping[str, Any], **how: Any) -> Risk:
    """Continue an interrupted risk from its arguments, `whole`, and the questions that it has begun.

    The answer is that of an undisturbed one; `how` has trust and an executor.
    """
    trust, executor, first = how["trust"], how["executor"], next(iter(questions.values()))
    for question in questions.values():
        open_question(asdict(question), folder, trust)
    options = {**whole["options"], "trust": trust, "core": first.core, "device": first.device}
    with as_bad_input(KeyError, TypeError, AttributeError):
        return _risk(whole["ego"], dict(whole), whole["bases"], folder, True, False, executor, options)


def _risk(
    ego: Any,
    whole: dict[str, Any],
    bases: Mapping[str, str | PathLike[str]],
    folder: Path | None,
    progress: bool,
    force: bool,
    executor: Executor | None,
    options: Mapping[str, Any],
) -> Risk:
    """Estimate a risk from its checked arguments, `whole`, which its parts record."""
    scenarios, sites = whole["scenarios"], whole["sites"]
    named = isinstance(ego, str)
    ego_name = ego if named else type(ego).__name__
    with as_bad_input(ValueError):
        chosen = _choose_scenarios(scenarios, sites, bases)
    with as_bad_input(TypeError, ValueError):
        if options.get("max_p") is not None:
            raise ValueError("Expected max_rate, a limit of the sum, not max_p.")
        asked = {"ego": ego_name, **options}
        questions = {name: Question(env_id=env_id, base=base, **asked) for name, (env_id, base) in chosen.items()}
    left_out = _find_misfits(questions, None if named else ego)
    with as_bad_input(ValueError):
        fitting = {name: each for name, each in questions.items() if name not in left_out}
        if not fitting:
            names = ", ".join(map(text.name_scenario, questions))
            raise ValueError(f"The ego fits none of the scenarios {names}. {next(iter(left_out.values()))}")
        studies = [prepare(question, None if named else ego) for question in fitting.values()]
        for study in studies:
            find_frequency(study)
    with contextlib.nullcontext() if folder is None else output_folder(folder, RISK, PICTURE, folders=fitting):
        if folder is not None and force:
            (folder / RISK).unlink(missing_ok=True)
            clear_runs({folder / name: study.question for name, study in zip(fitting, studies, strict=True)})
        elif folder is not None:  # all of them, before the first one is run
            check_no_results(folder, RISK)
            for part in (folder / name for name in fitting if not (folder / name / JOURNAL).exists()):
                check_no_results(part)
        done: list[ScenarioRisk] = []
        for study in studies:
            try:
                done.append(_evaluate(study, sites[1:], folder, progress, executor, whole))
            except RunInterrupted as error:
                known = "; ".join(
                    f"{one.name} {text.format_rate(one.rate.per_million_km)} per million km" for one in done
                )
                raise RunInterrupted(f"{error}{f' Done before: {known}.' if done else ''}", error.report) from None
        found = Risk(ego=ego_name, scenarios=tuple(done), left_out=left_out)
        if folder is not None:
            with unwritten_results(folder, found):
                found.save_plot(folder / PICTURE)
                replace_text(folder / RISK, format_json(found.to_dict()) + "\n")
            for name in fitting:
                (folder / name / JOURNAL).unlink(missing_ok=True)
    return found


def _choose_scenarios(
    asked: Sequence[str], sites: Sequence[str], bases: Mapping[str, str | PathLike[str]]
) -> dict[str, tuple[str, str]]:
    """Return environment id and base of each scenario by its short name; names as of `env_id_of`.

    Raises:
        ValueError: Unless the scenarios exist, count nothing twice, and have bases of these sites.
    """
    ids = {split_layout(env_id)[0]: env_id for env_id in map(env_id_of, asked)}
    given = {split_layout(env_id_of(name))[0]: base for name, base in bases.items()}
    scenarios = [find_scenario(each) for each in ids]
    names = [each.name for each in scenarios]
    if not asked or len(set(names)) < len(asked):
        raise ValueError(f"Expected one or more different scenarios, got {', '.join(asked) or 'none'}.")
    if len(given) < len(bases):
        raise ValueError(f"Expected one base for each scenario, got those of {', '.join(bases)}.")
    if set(TWICE) <= set(names):
        raise ValueError(f"Expected one of {', '.join(TWICE)}: a cut-in is a new leader, and would count twice.")
    for name in given.keys() - ids.keys():
        raise ValueError(f"A base is given for {name}, which is none of {', '.join(ids)}.")
    if not sites or len(set(sites)) < len(sites):
        raise ValueError(f"Expected one site or more, such as us101, each once; got {', '.join(sites) or 'none'}.")
    known = sorted({name for scenario in scenarios for name in list_sites(scenario)})
    if not known:
        raise ValueError(
            f"No base of {', '.join(names)} is of a site where events were counted, so there is no rate: "
            "rare-envs estimate gives the probability in a scenario."
        )
    for site in (each for each in sites if each not in known):
        owner, there = next((each.name for each in scenarios if site in each.bases), ""), ", ".join(map(repr, known))
        if owner:
            raise ValueError(
                f"{site!r} is no site, but a base of {owner}. The sites are {there}; --base {owner}={site} takes it."
            )
        hint = did_you_mean(site, known)
        raise ValueError(f"No base of {', '.join(names)} is of a site {site!r}{hint}; there are {there}.")
    return {
        each.name: (ids[env_id], choose_base(each, given.get(env_id), sites[0]))
        for env_id, each in zip(ids, scenarios, strict=True)
    }


def _find_misfits(questions: Mapping[str, Question], ego: Any) -> dict[str, str]:
    """Return why an ego, or that of the questions, does not fit scenarios by its observations or actions, by name."""
    found = {}
    with as_bad_input(ValueError, OSError):
        if ego is None:
            first = next(iter(questions.values()))
            ego = agents.load_ego(first.ego, algo=first.algo, trust=first.trust, stats=first.stats)
        for name, question in questions.items():
            try:
                build_problem(replace(question, base=None, ensemble=False), ego)
            except ValueError as error:
                found[name] = str(error)
    return found


def _evaluate(
    study: Study,
    other_sites: Sequence[str],
    folder: Path | None,
    progress: bool,
    executor: Executor | None,
    whole: Mapping[str, Any],
) -> ScenarioRisk:
    """Run one scenario and return its rate, with the spread between sites if there are others."""
    name = study.problem.world.scenario.name
    if folder is None:
        report = run(study, progress, executor=executor)
    else:
        report = run_into(folder / name, study, progress, executor=executor, whole=whole)
    assert report.rate is not None  # `risk` has looked for the frequency before
    with keep_answer(report):
        factors = compare_sites(report, other_sites, progress, executor)
    logs = [0.0, *(float(np.log(factors[site])) for site in other_sites if factors.get(site, 0) > 0)]
    rate = replace(report.rate, site_log_sd=float(np.std(logs, ddof=1)) if len(logs) > 1 else 0.0)
    return ScenarioRisk(report=report, rate=rate, site_factors=factors)


SIDES = ("A", "B")
"""Folders of the journals of both egos."""
UNLIMITED = 1e6
"""Upper over lower limit of a ratio from which on it is said to have none."""
LEAST = 1e-300
"""Floor of a ratio whose logarithm is taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RiskComparison:
    """Collisions per million km of two egos in the same draws of several scenarios, and the ratio of their sums."""

    ego_a: str
    """Ego A, as it was named."""
    ego_b: str
    """Ego B."""
    scenarios: Mapping[str, samplers.comparison.Comparison]
    """The comparison in each scenario, by name."""
    frequencies: Mapping[str, EventFrequency]
    """How often the events of each scenario happen."""
    max_ratio: float | None = None
    """Limit of the collisions of B over those of A."""
    assume_traffic: bool = False
    """Whether the verdict takes the traffic models as exact."""

    @cached_property
    def per_million_km(self) -> dict[str, float]:
        """Collisions per million km: of A, of B, and by which egos have them in the same draws."""
        found = dict.fromkeys(("a", "b", "both", "only_a", "only_b"), 0.0)
        for name, pair in self.scenarios.items():
            shares = {**pair.shares, "a": pair.a.p, "b": pair.b.p}
            for each in found:
                found[each] += exposure.MILLION_KM * self.frequencies[name].per_km * shares[each]
        return found

    @property
    def ratio(self) -> float:
        """Collisions of A over those of B; inf if B has none, NaN if neither has."""
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
        """Return draws of the sums of A and of B per km, the least and the most of each, (2, 2, n).

        From draws of B's rate in each scenario, by simulations, counts and refits, and of the ratio there, by its
        interval, with the traffic model or if that is `exact`. An ego without a failure in a scenario has 0 there for
        one limit of the ratio, and its upper limit for the other.
        """
        rng, n = np.random.default_rng(0), exposure.RATE_DRAWS
        ends = np.zeros((2, 2, n))
        for name, pair in self.scenarios.items():
            z, per_km = exposure.normal_quantile(pair.confidence), self.frequencies[name].per_km
            known = None if exact else pair.base_uncertainty
            fold, spread = fold_spread(None if exact else pair.either.base_uncertainty)
            common = per_km * np.exp(math.hypot(self.frequencies[name].log_sd, spread) * rng.standard_normal(n))
            a, b = (
                common * side.p * np.exp((fold * side.cov if side.p > 0 else 0.0) * rng.standard_normal(n))
                for side in (pair.a, pair.b)
            )
            low, high = pair.interval if known is None or known.interval is None else known.interval
            if pair.a.p > 0 and pair.b.p > 0:
                error = rng.standard_normal(n)
                away = np.where(error < 0, math.log(pair.ratio / max(low, LEAST)), math.log(high / pair.ratio))
                a = b * pair.ratio * np.exp(away / z * error)
            most_a = common * pair.a.interval[1] if pair.b.p == 0 else b * high
            most_b = common * pair.b.interval[1] if pair.a.p == 0 else a / max(low, LEAST)
            ends[0] += np.stack((a, a if pair.a.p > 0 else most_a))
            ends[1] += np.stack((b, b if pair.b.p > 0 else most_b))
        return ends

    def _find_interval(self, exact: bool) -> tuple[float, float]:
        """Return the interval of the ratio."""
        ends, tails = self._draw(exact), exposure.tail_levels(self.confidence)
        if not ends[:, 1].any():
            return 0.0, math.inf
        with np.errstate(divide="ignore", invalid="ignore"):
            least, most = ends[0, 0] / ends[1, 1], np.where(ends[1, 0] > 0, ends[0, 1] / ends[1, 0], math.inf)
        return float(np.quantile(least, tails[0])), float(np.quantile(most, tails[1], method="inverted_cdf"))

    def _find_rate_interval(self, sides: Sequence[Side]) -> exposure.RateInterval:
        """Return the interval of the rate of one ego per million km, of its p in each scenario."""
        rng, n, z = np.random.default_rng(0), exposure.RATE_DRAWS, exposure.normal_quantile(self.confidence)
        ends = np.zeros((2, n))
        for (name, pair), side in zip(self.scenarios.items(), sides, strict=True):
            counted, (_, spread) = self.frequencies[name], fold_spread(pair.either.base_uncertainty)
            events = counted.per_km * np.exp(counted.log_sd * rng.standard_normal(n))
            error, traffic = rng.standard_normal(n), np.exp(spread * rng.standard_normal(n))
            if side.p > 0:
                low, high = side.interval
                away = np.where(error < 0, math.log(side.p / max(low, LEAST)), math.log(high / side.p))
                ends += events * np.minimum(side.p * traffic * np.exp(away / z * error), 1.0)
            else:
                of_other = pair.b.p * pair.interval[1] if side is pair.a else pair.a.p / max(pair.interval[0], LEAST)
                most = min(side.interval[1], of_other or 1.0)
                ends[1] += events * np.minimum(most * traffic, 1.0)
        tails = exposure.tail_levels(self.confidence)
        low, high = (exposure.MILLION_KM * float(np.quantile(end, tail)) for end, tail in zip(ends, tails, strict=True))
        return low, high

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

    @property
    def people(self) -> HumanBenchmark | None:
        """Contacts of people in the same events together; None if those of one kind were not counted."""
        kinds: list[str] = []
        for name, pair in self.scenarios.items():
            kinds += [part.name for part in pair.either.parts if part.name in COUNTED] or [name]
        return add_people([count_people(kind) for kind in kinds])

    @cached_property
    def verdict(self) -> samplers.analysis.Verdict | None:
        """Whether B has fewer than `max_ratio` times as many collisions as A; None without a limit."""
        if self.max_ratio is None:
            return None
        own = find_doubt([each for each in self._name(lambda pair: pair.warnings) if RATIO_COARSE not in each])
        own = "no failure of A or B was found" if math.isnan(self.ratio) else own
        of_base = find_doubt([each for each in self.warnings if RATIO_COARSE not in each])
        bases = [pair.base_uncertainty for pair in self.scenarios.values()]

        def judge(exact: bool) -> samplers.analysis.Verdict:
            ends = self.interval_if_exact if exact else (0.0, math.inf) if self.left_out else self.interval
            low, high = (math.inf if end == 0 else 1.0 / end for end in reversed(ends))
            reason = own or ("" if exact else self.left_out or of_base)
            about: dict[str, Any] = {"quantity": "collisions of B / A", "includes_base": not exact and all(bases)}
            return judge_ends(self.max_ratio or 0.0, (low, high), self.confidence, reason, **about)

        found, is_exact = judge(self.assume_traffic), self.assume_traffic or not any(bases)
        return replace(found, if_exact=None if is_exact else judge(True).decision)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about the ratios and about the errors of their traffic models, by scenario."""
        return self._name(lambda pair: pair.all_warnings)

    def _name(self, find: Callable[[samplers.comparison.Comparison], Sequence[str]]) -> tuple[str, ...]:
        """Return texts about the scenarios, each behind the name of its own."""
        return tuple(
            f"{text.name_scenario(name)}: {each}" for name, pair in self.scenarios.items() for each in find(pair)
        )

    def __str__(self) -> str:
        """Return the answer, for people: the ratio, what limits it, both rates, and last the verdict."""
        return "\n".join(self.describe())

    def describe(self, last: Sequence[Row] = (), most: int = MOST_LINES) -> list[str]:
        """Return the lines of the answer, at most so many; `last` are facts before the verdict."""
        a, b = (Path(ego).name if Path(ego).suffix else ego for ego in (self.ego_a, self.ego_b))
        gate, names = text.list_gate(self.verdict), " and ".join(map(text.name_scenario, self.scenarios))
        title = textwrap.shorten(f"{a} (A) against {b} (B) in {names}", WIDTH, placeholder=" ...")
        rows = [*self._list_facts(a, b), *list_warnings(self.warnings), *last]
        return [title, *fold_rows(rows, most - 1 - len(gate)), *gate]

    def _list_facts(self, a: str, b: str) -> list[Row]:
        """Return the ratio, what limits it, the rate of each ego beside people, and what both share."""
        rates, (low, high) = self.per_million_km, self.interval
        pairs = [*self.scenarios.values()]
        bases = [pair.base_uncertainty for pair in pairs if pair.base_uncertainty is not None]
        n, known = f"{sum(pair.n_sim for pair in pairs):,}", self.left_out
        about: dict[str, Any] = {"a": a, "b": b, "fails": "crashes", "sure": f"{100 * self.confidence:g} %"}
        limit = say("limited by simulations", n=n, few="")
        if self.ratio > 0 and math.isfinite(self.ratio) and high > UNLIMITED * low:
            said = say("ratio without limits", ratio=format_alike(self.ratio)[0], **about)
        elif self.ratio > 0 and math.isfinite(self.ratio) and low > 0 and math.isfinite(high):
            ratio, *ends = format_alike(self.ratio, low, high)
            said = say("ratio", ratio=ratio, low=ends[0], high=ends[1], **about)
            said += say("undecided which", fails="crashes") if low <= 1 <= high else ""
            events = ", ".join(dict.fromkeys(each.fitted_to for each in bases))
            base = replace(bases[0], fitted_to=events) if bases else None
            limit = describe_limit(self.ratio, self.interval_if_exact, (low, high), n, MODEL_NOUN, base)
        elif math.isnan(self.ratio):
            said = say("ratio not known", **about)
        elif low > 0:
            said = say("ratio to a safe one" if rates["b"] == 0 else "ratio above", low=format_alike(low)[0], **about)
        else:
            fact = "ratio of a safe one" if rates["a"] == 0 else "ratio below"
            ratio, top = format_alike(self.ratio, high)
            said = say(fact, ratio=ratio, high=top, **about)
        counted, sides = text.describe_people(self.people), list[Row]()
        for name, letter, own in ((a, "A", [each.a for each in pairs]), (b, "B", [each.b for each in pairs])):
            rate_ends = self._find_rate_interval(own)
            rate = text.format_with_interval(rates[letter.lower()], rate_ends, " per million km")
            sides.append((name if len(name) < LABEL - 1 else letter, say("rate of all", rate=rate, people=counted)))
        per_km = (exposure.MILLION_KM * self.frequencies[name].per_km for name in self.scenarios)
        both, first, second = format_shares(list(zip(per_km, pairs, strict=True)))
        shares = f"{say('shares', both=both, a=a, first=first, b=b, second=second)} per million km"
        left_out = known and say("error not known", model=MODEL_NOUN, reason=known)
        rows = [("Ratio", said), ("Limited by", limit), ("Left out", left_out), *sides, ("Together", shares)]
        return [row for row in rows if row[1]]

    def details(self) -> str:
        """Return a table by scenario, all that is known of each, and all warnings."""
        rows: list[tuple[str, ...]] = [("per million km", "A", "B", "both", "only A", "only B")]
        for name, pair in self.scenarios.items():
            alone = replace(self, scenarios={name: pair})
            rows.append((text.name_scenario(name), *map(text.format_rate, alone.per_million_km.values())))
        rows.append(("all", *map(text.format_rate, self.per_million_km.values())))
        lines = text.tabulate(rows)
        for name, pair in self.scenarios.items():
            lines += ["", text.name_scenario(name), *pair.details().splitlines()]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinities and NaN become None."""
        ends = (*self.interval, self.ratio)
        low, high, ratio = (end if math.isfinite(end) else None for end in ends)
        return {
            "ego_a": self.ego_a,
            "ego_b": self.ego_b,
            "ratio": ratio,
            "interval": [low, high],
            "per_million_km": dict(self.per_million_km),
            "people": None if self.people is None else self.people.to_dict(),
            "scenarios": {name: pair.to_dict() for name, pair in self.scenarios.items()},
            "gate": None if self.verdict is None else self.verdict.to_dict(),
            "warnings": list(self.warnings),
            "text": self.describe(most=text.WHOLE),
            "version": __version__,
        }


def compare_risks(
    ego_a: str,
    ego_b: str,
    *,
    scenarios: Sequence[str] = SCENARIO_SET,
    site: str = "us101",
    bases: Mapping[str, str | PathLike[str]] | None = None,
    out: str | PathLike[str] | None = None,
    progress: bool = False,
    force: bool = False,
    algo_b: str | None = None,
    stats_b: str | None = None,
    executor: Executor | None = None,
    **options: Any,
) -> RiskComparison:
    """Compare two egos, such as a policy and "cc_human", in the same draws of the scenarios of `risk`.

    Args:
        ego_a: Name, file or address of ego A.
        ego_b: The same of ego B; `algo_b` and `stats_b` belong to its .zip.
        scenarios: Scenarios that count nothing twice, as of `risk`.
        site: Site of the bases.
        bases: Base distributions by scenario, in place of those of the site.
        out: Folder for comparison.json and a folder of each scenario, which `rare-envs resume` continues.
        progress: Show a bar on standard error.
        force: Replace what the folder has.
        algo_b: As `Question.algo`, of ego B.
        stats_b: As `Question.stats`, of ego B.
        executor: As of `samplers.estimate`.
        **options: Further fields of `rare_envs.study.Question`; max_sim is of each scenario.

    Raises:
        BadInput: An argument cannot be used, or an ego does not fit a scenario.
        RunInterrupted: It was interrupted.

    Example:
        >>> from rare_envs.study.risk import compare_risks
        >>> found = compare_risks("idm", "rss", scenarios=["car_following"], method="mc", max_sim=200, seed=0)
        >>> found.per_million_km["a"], found.ratio
        (0.0, nan)
    """
    whole: dict[str, Any] = {
        "command": SUM,
        "ego_a": ego_a,
        "ego_b": ego_b,
        "scenarios": [*scenarios],
        "site": site,
        "bases": {name: str(base) for name, base in (bases or {}).items()},
        "b": {"algo_b": algo_b, "stats_b": stats_b},
        "chunked": executor is not None,
        "options": {name: value for name, value in options.items() if name not in CHANGEABLE},
    }
    return _compare_sums(whole, None if out is None else Path(out), progress, force, executor, options)


def resume_compared_risks(
    folder: Path, questions: Mapping[str, Question], whole: Mapping[str, Any], **how: Any
) -> RiskComparison:
    """Continue an interrupted comparison of risks, as `resume_risk`."""
    trust, executor, first = how["trust"], how["executor"], next(iter(questions.values()))
    for question in questions.values():
        open_question(asdict(question), folder, trust)
    options = {**whole["options"], "trust": trust, "device": first.device}  # the cores of A and B may differ
    with as_bad_input(KeyError, TypeError, AttributeError):
        return _compare_sums(dict(whole), folder, True, False, executor, options)


def _compare_sums(
    whole: dict[str, Any],
    folder: Path | None,
    progress: bool,
    force: bool,
    executor: Executor | None,
    options: Mapping[str, Any],
) -> RiskComparison:
    """Compare two egos from checked arguments, `whole`, which the parts record."""
    ego_a, ego_b, of_b = whole["ego_a"], whole["ego_b"], whole["b"]
    with as_bad_input(TypeError, ValueError):
        chosen = _choose_scenarios(whole["scenarios"], [whole["site"]], whole["bases"])
        asked = [Question(env_id=env_id, base=base, ego=ego_a, **options) for env_id, base in chosen.values()]
        frequencies = {name: find_frequency(prepare(each)) for name, each in zip(chosen, asked, strict=True)}
    if folder is not None:
        parts = {folder / name / side: each for name, each in zip(chosen, asked, strict=True) for side in SIDES}
        if force:
            clear_runs(parts)
            for path in (folder, *(folder / name for name in chosen)):
                (path / COMPARISON).unlink(missing_ok=True)
                (path / FAILURES).unlink(missing_ok=True)
        check_no_results(folder, COMPARISON)
        for name in chosen:
            if not any((folder / name / side / JOURNAL).exists() for side in SIDES):
                check_no_results(folder / name, COMPARISON)
    with contextlib.nullcontext() if folder is None else output_folder(folder, COMPARISON, folders=chosen):
        pairs = {}
        for name, question in zip(chosen, asked, strict=True):
            part = None if folder is None else folder / name
            how: dict[str, Any] = {**of_b, "executor": executor, "whole": whole}
            pairs[name], _ = compare_egos(question, ego_b, progress, part, **how)
        found = RiskComparison(
            ego_a=ego_a,
            ego_b=ego_b,
            scenarios=pairs,
            frequencies=frequencies,
            max_ratio=asked[0].max_ratio,
            assume_traffic=asked[0].assume_traffic,
        )
        if folder is not None:
            with unwritten_results(folder, found):
                replace_text(folder / COMPARISON, format_json(found.to_dict()) + "\n")
            for side in parts:
                (side / JOURNAL).unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # it has more
                    side.rmdir()
    return found
