"""Risk: collisions of an ego per million km over scenarios that count nothing twice."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

import agents
import samplers
from rare_envs import exposure
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.files import format_json, replace_text
from rare_envs.people import EventRate, HumanBenchmark, sum_people
from rare_envs.plugins import did_you_mean
from rare_envs.scenarios.base import Scenario, load_base
from rare_envs.scenarios.registry import env_id_of, find_scenario, split_layout
from rare_envs.startup import __version__
from rare_envs.study import text
from rare_envs.study.arguments import Question, RunInterrupted, as_bad_input, keep_answer
from rare_envs.study.evaluate import run, run_into
from rare_envs.study.plots import save_risk_plot
from rare_envs.study.question import CHANGEABLE, Study, build_problem, prepare
from rare_envs.study.report import Report, find_frequency, judge_rate
from rare_envs.study.run_folder import JOURNAL, RISK
from rare_envs.study.writing import begin_journal, folder_of_parts, unwritten_results
from samplers.evaluate import Executor
from samplers.output import MOST_LINES, WIDTH, Row, fold_rows
from samplers.result import list_warnings

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
        reports = [each.report for each in self.scenarios]

        def judge(assume_traffic: bool) -> samplers.analysis.Verdict:
            doubts = (each.find_indecision(assume_traffic) for each in reports)
            reason = next(filter(None, [*missing, *doubts]), "")
            found = [(each.report.find_judged_rate(assume_traffic), each.rate.site_log_sd) for each in self.scenarios]
            rates = tuple(replace(rate, site_log_sd=spread) for rate, spread in found)
            judged = all(each.judges_traffic(assume_traffic) for each in reports)
            return judge_rate(limit, exposure.TotalRate(rates), reason, judged)

        verdict = judge(reports[0].study.question.assume_traffic)
        return replace(verdict, if_exact=judge(True).decision if verdict.includes_base else None)

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
        per_km = text.format_events(total, "", level)
        beside = "" if counted is None else f"; people {text.describe_people(counted, total.confidence)}"
        shares = {kind: rate / whole for kind, rate in kinds.items()} if whole else {}
        rows = {
            "Limited by": text.describe_uncertainty(total),
            "Calibration": text.describe_calibrations(self.events),
            "Crashes": text.describe_kinds(shares),
            "Injuries": "" if self.injuries is None else text.describe_injuries(self.injuries),
        }
        facts = [*(row for row in rows.items() if row[1]), *list_warnings(self.warnings), *last]
        gate, table = text.list_gate(self.verdict), text.tabulate_events(self.events, total)
        title = f"{self.ego}: collisions per million km {per_km}{beside}"
        return [*textwrap.wrap(title, WIDTH), *table, *fold_rows(facts, most - 1 - len(table) - len(gate)), *gate]

    def details(self) -> str:
        """Return the traffic behind each scenario, what the columns are, and all notes and warnings."""
        lines = [f"traffic      {'; '.join(each.describe_traffic() for each in self.scenarios)}"]
        lines += [f"human model  {text.COLUMNS}"]
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
            or `rare-envs resume`, continues with the simulations that it has, unless the ego is an object.
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
    about = {"command": "risk", "ego": ego if isinstance(ego, str) else "", "scenarios": scenarios, "sites": sites}
    whole = describe_command(bases, executor, options, **about)
    return add_risks(ego, whole, None if out is None else Path(out), progress, force, executor, options)


def describe_command(
    bases: Mapping[str, str | PathLike[str]] | None, executor: Executor | None, options: Mapping[str, Any], **about: Any
) -> dict[str, Any]:
    """Return what a command over scenarios is `about`, and its arguments, which the journals of its parts have."""
    named = {name: str(base) for name, base in (bases or {}).items()}
    asked = {name: value for name, value in options.items() if name not in CHANGEABLE}
    return {**about, "bases": named, "chunked": executor is not None, "options": asked}


def list_asked(whole: Mapping[str, Any]) -> list[Question]:
    """Return questions with all that the arguments of a command over scenarios name; nothing of it is loaded.

    There is one for each ego in each environment and base, in any spelling.
    """
    names, bases, egos = [*whole["scenarios"], *whole["bases"]], whole["bases"], [{"ego": whole.get("ego")}]
    if "b" in whole:
        b = {"ego": whole["ego_b"], "algo": whole["b"]["algo_b"], "stats": whole["b"]["stats_b"]}
        egos = [{"ego": whole["ego_a"]}, b]
    worlds = [{**whole["options"], "env_id": name, "base": bases.get(name)} for name in names]
    return [Question(**{**world, **ego}) for world in worlds for ego in egos]


def add_risks(
    ego: Any,
    whole: dict[str, Any],
    folder: Path | None,
    progress: bool,
    force: bool,
    executor: Executor | None,
    options: Mapping[str, Any],
) -> Risk:
    """Estimate a risk from its checked arguments, `whole`, which its parts record."""
    named = isinstance(ego, str)
    ego_name = ego if named else type(ego).__name__
    with as_bad_input(TypeError, ValueError):
        chosen = choose_scenarios(whole["scenarios"], whole["sites"], whole["bases"])
        if options.get("max_p") is not None:
            raise ValueError("Expected max_rate, a limit of the sum, not max_p.")
        asked = {**options, "ego": ego_name}
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
    parts = {name: study.question for name, study in zip(fitting, studies, strict=True)}
    with folder_of_parts(folder, parts, list_asked(whole), force, RISK, PICTURE):
        for path, question in ((folder / name, part) for name, part in parts.items()) if folder and named else ():
            if (path / JOURNAL).exists():  # wherever it is stopped, all go on by the on_error of now
                begin_journal(path, question, whole=whole).close()
        done: list[ScenarioRisk] = []
        for study in studies:
            try:
                done.append(_evaluate(study, whole["sites"][1:], folder, progress, executor, whole))
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
    return found


def choose_scenarios(
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
