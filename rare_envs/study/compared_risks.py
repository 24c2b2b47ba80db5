"""Comparison of two egos by collisions per million km, near-crashes and injuries, summed over scenarios.

Near-crashes are less rare than crashes and have a run of their own, with `NEAR_SHARE` of the simulations.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import samplers
from rare_envs import exposure
from rare_envs.distributions.events import EventFrequency
from rare_envs.egos.reference import REFERENCE_EGOS
from rare_envs.files import format_json, replace_text
from rare_envs.people import HumanBenchmark
from rare_envs.startup import __version__
from rare_envs.study import text, writing
from rare_envs.study.arguments import Question, as_bad_input
from rare_envs.study.comparison import (
    DELTA_V,
    INJURIES,
    ComparedEgos,
    RateComparison,
    compare_egos,
    list_kinds,
    list_numbers,
)
from rare_envs.study.question import open_question, prepare
from rare_envs.study.report import MODEL_NOUN, find_frequency
from rare_envs.study.risk import SCENARIO_SET, Risk, add_risks, choose_scenarios, describe_command, list_asked
from rare_envs.study.run_folder import COMPARISON, FAILURES, SIDES
from samplers.analysis.gate import find_doubt, judge_ends
from samplers.comparison import RATIO_COARSE, Comparison, list_ratio_rows
from samplers.evaluate import Executor
from samplers.output import LABEL, MOST_LINES, WIDTH, Row, fold_rows, say
from samplers.problem import check_whole
from samplers.result import list_warnings

CRASHES, NEAR_CRASHES = "crashes", "near_crashes"
"""What is compared beside `INJURIES` and `DELTA_V`; near-crashes with crashes."""
NEAR_SHARE = 0.25
"""Part of max_sim that is for near-crashes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RiskComparison(RateComparison):
    """Collisions of two egos per million km, their ratio, and the same of near-crashes and of severe crashes."""

    ego_a: str
    """Ego A, as it was named."""
    ego_b: str
    """Ego B."""
    outcomes: Mapping[str, RateComparison] = field(default_factory=dict)
    """The same of near-crashes, of serious injuries and of crashes with a larger delta-v, by their names."""
    kinds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Crashes of A per million km, and those of them that B avoids, by kind."""
    notes: tuple[str, ...] = ()
    """What is not known."""
    max_ratio: float | None = None
    """Limit of the collisions of B over those of A."""
    assume_traffic: bool = False
    """Whether the verdict takes the traffic models as exact."""

    @property
    def people(self) -> HumanBenchmark | None:
        """Contacts of people in the same events together; None if those of one kind were not counted."""
        return self.count_people("contacts")

    @property
    def n_sim(self) -> int:
        """Simulations of A and of B together."""
        near = self.outcomes[NEAR_CRASHES].scenarios.values() if NEAR_CRASHES in self.outcomes else ()
        return sum(pair.n_sim for pair in (*self.scenarios.values(), *near))

    @cached_property
    def verdict(self) -> samplers.analysis.Verdict | None:
        """Whether B has fewer than `max_ratio` times as many collisions as A; None without a limit."""
        if self.max_ratio is None:
            return None
        of_base = find_doubt([each for each in super().warnings if RATIO_COARSE not in each])
        own = find_doubt([each for each in self._name(lambda pair: pair.warnings) if RATIO_COARSE not in each])
        own = "no failure of A or B was found" if math.isnan(self.ratio) else own
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
        """Doubts about the ratios and about the errors of their traffic models, those of near-crashes included."""
        near = self.outcomes.get(NEAR_CRASHES)
        more = () if near is None else near.warnings
        return (*super().warnings, *(f"near-crashes, {each}" for each in more))

    def __str__(self) -> str:
        """Return the answer, for people: the ratio, what limits it, the rates by outcome, and last the verdict."""
        return "\n".join(self.describe())

    def describe(self, last: Sequence[Row] = (), most: int = MOST_LINES + 2) -> list[str]:
        """Return the lines of the answer, about so many; `last` are facts before the verdict."""
        a, b = text.shorten_egos(self.ego_a, self.ego_b)
        gate, names = text.list_gate(self.verdict), " and ".join(map(text.name_scenario, self.scenarios))
        title = textwrap.shorten(f"{a} (A) against {b} (B) in {names}", WIDTH, placeholder=" ...")
        more = [*text.list_avoided(self.kinds, a, b), *list_warnings(self.warnings), *last]
        table = self.tabulate_outcomes((CRASHES, NEAR_CRASHES, INJURIES))
        left = most - 1 - len(table) - len(gate)
        facts, rest = fold_rows(self._list_facts(a, b), left - len(more)), fold_rows(more, max(left - 5, len(more)))
        return [title, *facts, *table, *rest, *gate]

    def tabulate_outcomes(self, names: Sequence[str] = ()) -> list[str]:
        """Return the table of outcomes, of all but for these names."""
        rows: list[tuple[str, ...]] = [
            ("per million km", "A", "B", f"A / B ({100 * self.confidence:g} %)", "both", "only A", "only B", "people")
        ]
        counted = {CRASHES: ("contacts",), NEAR_CRASHES: ("contacts", "near_crashes")}
        for name, each in {CRASHES: self, **self.outcomes}.items():
            if name in (names or (name,)):
                people = each.count_people(*counted[name]) if name in counted else None
                rows.append(each.tabulate(text.OUTCOME_NOUNS.get(name, name), people))
        return text.tabulate(rows)

    def _list_facts(self, a: str, b: str) -> list[Row]:
        """Return the ratio, what limits it, and the rate of each ego beside people."""
        bases = [each for pair in self.scenarios.values() if (each := pair.base_uncertainty) is not None]
        events, known = ", ".join(dict.fromkeys(each.fitted_to for each in bases)), self.left_out
        base = replace(bases[0], fitted_to=events) if bases and not known else None
        about = {"a": a, "b": b, "fails": "crashes"}
        rows = list_ratio_rows(
            self.ratio, self.interval_if_exact, self.interval, self.confidence, self.n_sim, base, MODEL_NOUN, **about
        )
        if known:
            rows.append(("Left out", say("error not known", model=MODEL_NOUN, reason=known)))
        counted, sides = self.people, list[str]()
        for name, letter, rate in zip((a, b), SIDES, self.rates.values(), strict=False):
            name = name if len(name) < LABEL - 1 else letter
            sides.append(f"{name} {text.format_events(rate)}")
        sides.append(f"people {text.describe_people(counted, self.confidence)}")
        rows.append(("Crash rates", ", ".join(sides)))
        for name, ego, rate in zip((a, b), (self.ego_a, self.ego_b), self.rates.values(), strict=False):
            above = 0.0 if counted is None else rate.per_million_km / counted.interval_at(self.confidence)[1]
            if ego in REFERENCE_EGOS and counted is not None and above > 1:
                times = text.format_rate(rate.per_million_km / counted.per_million_km)
                rows.append(("Careful", say("above people", name=name, times=times)))
        near = self.outcomes.get(NEAR_CRASHES, self).per_million_km
        if any(near[key] < self.per_million_km[key] for key in ("a", "b", "both")):  # the two have runs of their own
            rows.append(("Careful", say("near below")))
        return rows

    def details(self) -> str:
        """Return a table by scenario, all outcomes, all that is known of each, and all warnings."""
        rows: list[tuple[str, ...]] = [("per million km", "A", "B", "both", "only A", "only B")]
        for name, pair in self.scenarios.items():
            alone = RateComparison(scenarios={name: pair}, frequencies=self.frequencies)
            rows.append((text.name_scenario(name), *map(text.format_rate, alone.per_million_km.values())))
        rows.append(("all", *map(text.format_rate, self.per_million_km.values())))
        lines = [*text.tabulate(rows), "", *self.tabulate_outcomes()]
        for name, pair in self.scenarios.items():
            lines += ["", text.name_scenario(name), *pair.details().splitlines()]
        return "\n".join([*lines, *(f"note: {each}" for each in self.notes)])

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinities and NaN become None."""
        scenarios = {}
        for name, pair in self.scenarios.items():
            others = {key: list_numbers(each.scenarios[name]) for key, each in self.outcomes.items()}
            scenarios[name] = {**pair.to_dict(), "outcomes": others}
        return {
            "ego_a": self.ego_a,
            "ego_b": self.ego_b,
            **super().to_dict(),
            "outcomes": {name: each.to_dict() for name, each in self.outcomes.items()},
            "kinds_of_a": list_kinds(self.kinds, "per_million_km"),
            "n_sim": self.n_sim,
            "people": None if self.people is None else self.people.to_dict(),
            "scenarios": scenarios,
            "gate": None if self.verdict is None else self.verdict.to_dict(),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
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
        out: Folder for comparison.json and two folders of each scenario, one of them of near-crashes; `rare-envs
            resume` continues it.
        progress: Show a bar on standard error.
        force: Replace what the folder has.
        algo_b: As `Question.algo`, of ego B.
        stats_b: As `Question.stats`, of ego B.
        executor: As of `samplers.estimate`.
        **options: Further fields of `rare_envs.study.Question`; max_sim is of each scenario, near-crashes included.

    Raises:
        BadInput: An argument cannot be used, or an ego does not fit a scenario.
        RunInterrupted: It was interrupted.

    Example:
        >>> from rare_envs.study.compared_risks import compare_risks
        >>> found = compare_risks("idm", "rss", scenarios=["hard_brake"], method="mc", max_sim=200, seed=0)
        >>> found.per_million_km["a"], found.ratio
        (0.0, nan)
    """
    egos: dict[str, Any] = {"ego_a": ego_a, "ego_b": ego_b, "b": {"algo_b": algo_b, "stats_b": stats_b}}
    about = {"command": writing.SUM, **egos, "scenarios": [*scenarios], "sites": [site]}
    whole = describe_command(bases, executor, options, **about)
    return _compare_sums(whole, None if out is None else Path(out), progress, force, executor, options)


def resume_sum(
    folder: Path,
    questions: Mapping[str, Question],
    whole: Mapping[str, Any],
    trust: bool = False,
    executor: Executor | None = None,
    on_error: str | None = None,
) -> Risk | RiskComparison:
    """Continue an interrupted risk or comparison of risks; the answer is that of an undisturbed one.

    `whole` are its arguments, and `questions` those that it has begun; faults of a risk may count otherwise from now.
    """
    first = next(iter(questions.values()))
    with as_bad_input(KeyError, TypeError, AttributeError):
        for question in list_asked(whole):
            open_question(asdict(question), folder, trust)
        options = {**whole["options"], "trust": trust, "device": first.device}
        if whole["command"] == writing.SUM:  # the cores of A and B may differ
            return _compare_sums(dict(whole), folder, True, False, executor, options)
        known = (question.on_error for question in questions.values())  # one may have gone on alone, by another
        options |= {"core": first.core, "on_error": on_error or max(known, key=lambda each: each != "raise")}
        return add_risks(whole["ego"], dict(whole), folder, True, False, executor, options)


def _ask_near(question: Question) -> tuple[Question, Question]:
    """Return the question of crashes and that of near-crashes, which share the simulations."""
    n = question.max_sim
    if n is not None:
        check_whole("max_sim (of A and B, crashes and near-crashes)", n, 8)  # two draws of each
    near = None if n is None else max(4, round(NEAR_SHARE * n))
    more = replace(question, measure="near_crash", gamma=0.0, max_ratio=None, core="auto", max_sim=near)
    return replace(question, max_sim=None if n is None or near is None else n - near), more


def _compare_sums(
    whole: dict[str, Any],
    folder: Path | None,
    progress: bool,
    force: bool,
    executor: Executor | None,
    options: Mapping[str, Any],
) -> RiskComparison:
    """Compare two egos from checked arguments, `whole`, which the parts record."""
    ego_a, ego_b, of_b, asked = whole["ego_a"], whole["ego_b"], whole["b"], dict[str, Question]()
    with as_bad_input(TypeError, ValueError):
        chosen = choose_scenarios(whole["scenarios"], whole["sites"], whole["bases"])
        frequencies = dict[str, EventFrequency]()
        for name, (env_id, base) in chosen.items():
            asked[name], asked[f"{name}_{NEAR_CRASHES}"] = _ask_near(
                Question(env_id=env_id, base=base, ego=ego_a, **options)
            )
            frequencies[name] = find_frequency(prepare(asked[name]))
    parts = {f"{name}/{side}": each for name, each in asked.items() for side in SIDES}
    with writing.folder_of_parts(folder, parts, list_asked(whole), force, COMPARISON, FAILURES):
        pairs = {}
        for name, question in asked.items():
            part = None if folder is None else folder / name
            how: dict[str, Any] = {**of_b, "executor": executor, "whole": whole}
            pairs[name] = compare_egos(question, ego_b, progress, part, **how)
        sums = _add_up({name: (pairs[name], pairs[f"{name}_{NEAR_CRASHES}"].found) for name in chosen}, frequencies)
        first = next(iter(asked.values()))
        limit: dict[str, Any] = {"max_ratio": first.max_ratio, "assume_traffic": first.assume_traffic}
        found = RiskComparison(ego_a=ego_a, ego_b=ego_b, frequencies=frequencies, **sums, **limit)
        if folder is not None:
            with writing.unwritten_results(folder, found):
                replace_text(folder / COMPARISON, format_json(found.to_dict()) + "\n")
    return found


def _add_up(
    pairs: Mapping[str, tuple[ComparedEgos, Comparison]], frequencies: Mapping[str, EventFrequency]
) -> dict[str, Any]:
    """Return the fields of a `RiskComparison` from the pairs in each scenario, and their near-crashes."""
    outcomes = {NEAR_CRASHES: {name: near for name, (_, near) in pairs.items()}}
    severities = {name: pair.severity for name, (pair, _) in pairs.items()}
    for key in (INJURIES, *DELTA_V):
        if all(key in each.outcomes for each in severities.values()):
            outcomes[key] = {name: each.outcomes[key] for name, each in severities.items()}
    kinds = dict[str, tuple[float, float]]()
    for name, each in severities.items():
        for kind, share in each.kinds.items():
            known = kinds.get(kind, (0.0, 0.0))
            scale = exposure.MILLION_KM * frequencies[name].per_km
            kinds[kind] = known[0] + scale * share[0], known[1] + scale * share[1]
    unknown = (
        f"{text.name_scenario(name)}: severity is not known: {each.unknown}"
        for name, each in severities.items()
        if each.unknown
    )
    return {
        "scenarios": {name: pair.found for name, (pair, _) in pairs.items()},
        "outcomes": {key: RateComparison(scenarios=each, frequencies=frequencies) for key, each in outcomes.items()},
        "kinds": dict(sorted(kinds.items(), key=lambda kind: -kind[1][0])),
        "notes": tuple(unknown),
    }
