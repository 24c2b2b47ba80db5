"""Text of an answer: the number, what it rests on, rates, crashes; on the terminal and in the report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import samplers
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.exposure import (
    CollisionRate,
    RateInterval,
    TotalRate,
    VarianceShare,
    describe_human_contacts,
    summarise_human_contacts,
)
from rare_envs.measures import MEASURES
from rare_envs.study.episodes import MAX_SHOWN, draw_ordinary, find_ordinary_range, format_value, list_columns
from rare_envs.study.failures import KIND_DESCRIPTIONS
from rare_envs.study.report import BaseAnswer, Report
from samplers.output import indent_lines
from samplers.problem import FloatArray
from samplers.sample import describe_outcome

EVENT_NOUNS = {"cut_in": "cut-ins", "hard_brake": "brakings", "car_following": "new leaders"}
"""Events of the scenarios, in the plural."""
SOURCE_NOUNS = {"counts": "event counts", "sampling": "simulation"}
PART_NOUNS = {"base": "base distribution", "site": "difference between sites", **SOURCE_NOUNS}
LARGE, SMALL, SMALL_BESIDE = 99.5, 0.01, 0.001
"""Rates from which whole numbers are shown, and below which powers of ten: alone, and beside a rate above `SMALL`."""


def format_rate(value: float) -> str:
    """Return a rate with two digits."""
    return format_alike(value)[0]


def format_alike(*values: float) -> list[str]:
    """Return rates with two digits, all as decimals or all with powers of ten."""
    sizes = [value for value in values if value > 0 and math.isfinite(value)]
    least = SMALL if max(sizes, default=SMALL) < SMALL else SMALL_BESIDE
    decimal = all(value >= least for value in sizes)

    def write(value: float) -> str:
        if value <= 0 or not math.isfinite(value):
            return f"{value:g}"
        if not decimal:
            return f"{value:.1e}"
        if value >= LARGE:
            return f"{round(value, 1 - math.floor(math.log10(value))):,.0f}"
        return f"{value:#.2g}".rstrip(".")

    return [write(value) for value in values]


def format_with_interval(value: float, interval: RateInterval, unit: str = "", level: str = "") -> str:
    """Return a rate with its interval, or what it is below, all numbers in one form."""
    middle, low, high = format_alike(value, *interval)
    return f"{middle}{unit} ({level}{f'{low} to' if interval[0] > 0 else 'below'} {high})"


def format_share(share: float) -> str:
    """Return a share in per cent: whole, or one digit below 1 %."""
    return f"{100 * share:.0f} %" if share >= 0.01 else f"{100 * share:.1g} %"


def name_scenario(name: str) -> str:
    """Return the name of a scenario in words: "hard brake"."""
    return "cut-in" if name == "cut_in" else name.replace("_", " ")


def describe_injuries(rate: CollisionRate | TotalRate) -> str:
    """Return a rate of serious injuries with its interval, in words."""
    return "serious injuries (MAIS 3+) " + format_with_interval(
        rate.per_million_km, rate.interval_per_million_km, " per million km", f"{100 * rate.confidence:g} %: "
    )


def describe_uncertainty(total: TotalRate, recorded: dict[str, int]) -> str:
    """Return what the uncertainty of a total comes from; empty if it is not known.

    Where a rate is not determined, the shares are those of the sum of the others.
    """
    parts = []
    if total.shares:
        whole = len(total.determined) == len(total.rates)
        of_what = "the uncertainty" if whole else "the uncertainty of the determined part"
        sources = ", ".join(f"{format_share(each.share)} {name_source(each)}" for each in total.shares)
        parts.append(f"{of_what} is {sources}")
    needed = total.further_events(recorded) if total.shares else None
    if needed is not None:
        events = EVENT_NOUNS.get(needed.scenario, "events")
        what = f"about {format_rate(needed.number or 0.0)} further recorded {events} would halve it"
        if needed.number is None:
            own = f"about {format_rate(needed.own)} would halve their own part"
            what = f"further {events} alone would not halve it; {own}"
        parts.append(f"{what} (a spread falls with 1 / sqrt(events))")
    for rate in (each for each in total.rates if not each.determined):
        high = format_rate(rate.interval_per_million_km[1])
        parts.append(f"{name_scenario(rate.scenario)} is not determined, and adds {high} to the upper end")
    return "; ".join(parts)


def name_source(each: VarianceShare) -> str:
    """Return a source of uncertainty in words, such as "the cut-in distribution"."""
    scenario = name_scenario(each.scenario)
    nouns = {"base": f"the {scenario} distribution", "site": f"{scenario} at other sites", **SOURCE_NOUNS}
    return nouns[each.source]


Result = Mapping[str, Any]
WIDE_BASE = 10.0
"""Ratio of the ends of the interval of the base distribution from which on the report warns of it."""
SIZED_BY_BUDGET = ("mc", "is", "two-stage", "surrogate")
"""Methods whose setting n is their budget where max_sim does not say; the n of others is that of a level."""


def format_probability(p: float | None, like: float | None = None) -> str:
    """Return a probability for people: as a percentage, or in powers of ten where it is small."""
    if p is None or not math.isfinite(p):
        return "not known"
    if p <= 0:
        return "0"
    if (p if like is None else like) >= 0.001:
        return f"{100 * p:.2g} %"
    mantissa, _, exponent = f"{p:.1e}".partition("e")
    return f"{mantissa} × 10{str(int(exponent)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"


def format_odds(p: float) -> str:
    """Return a probability as one in so many."""
    if p <= 0:
        return "none"
    if p > 0.1:
        return f"about {100 * p:.0f} in 100"
    n = 1 / p
    return f"about 1 in {float(f'{n:.2g}'):,.0f}"


def explain_no_gain(p: float) -> str:
    """Return why there is no gain over Monte Carlo."""
    if p <= 0:
        return "not known, as nothing that failed counts in p"
    return "none, as every scenario fails" if p >= 1 else "not known, as the c.o.v. is 1 or more"


def describe_event(result: Result) -> str:
    """Return what is counted, in words."""
    question = result.get("question") or {}
    measure, gamma = str(question.get("measure", "")), float(result.get("gamma", 0.0))
    if measure == "ttc" and gamma == 0.0:
        return "ends in a collision"
    what = "the measure" if ":" in measure or not measure else f"the least {measure}"
    return f"comes to f ≤ {gamma:g}, f being {what}"


def summarise_answer(result: Result, base: str) -> str:
    """Return the answer in a sentence, or two."""
    p = float(result["p"])
    where = f"Scenarios: {(result.get('question') or {}).get('env_id')} with traffic as in {base}."
    if p > 0:
        return f"{format_odds(p).capitalize()} scenarios {describe_event(result)}. {where}"
    percent, rare = f"{100 * float(result['confidence']):g} %", 1 / float(result["interval"][1])
    n, found, event = int(result.get("n_sim", 0)), int(result.get("n_failures") or 0), describe_event(result)
    seen = f"None of {n:,} simulations {event}"
    if found:
        seen = f"Of {n:,} simulations {found:,} found what {event}, but none of those counts in p (as in a search)"
    return f"{seen}; with {percent} confidence fewer than 1 in {rare:,.0f} do. {where}"


def describe_intervals(result: Result) -> list[tuple[str, str, str]]:
    """Return the intervals of p: name, ends, and what each holds."""
    confidence, p = float(result["confidence"]), float(result["p"])
    low, high = (format_probability(float(end), p) for end in result["interval"])
    what = "error of a finite number of simulations; the model of traffic taken as true"
    if isinstance(result.get("gate"), dict):
        what += f"; each end is one-sided at {50 + 50 * confidence:g} %, for the limit of --max-p"
    rows = [(f"{100 * confidence:g} %, sampling", f"{low} to {high}", what)]
    base = result.get("base_uncertainty")
    if isinstance(base, dict):
        low, high = (format_probability(end, p) for end in base.get("interval") or (None, None))
        mean = format_probability(base.get("expected"), p)
        what = f"what the recorded events allow ({base.get('fitted_to', '')}); predictive mean {mean}"
        ends = f"{low} to {high}" if base.get("interval") else "not determined"
        rows.append((f"{100 * float(base.get('confidence') or 0.95):g} %, base distribution", ends, what))
    return rows


def describe_wide_base(result: Result) -> str:
    """Return how far the events behind the base distribution leave p open; empty below `WIDE_BASE`."""
    base = result.get("base_uncertainty")
    if not isinstance(base, dict) or not result["p"]:
        return ""
    behind, ends = f" ({base.get('fitted_to', '')})", base.get("interval")
    if ends is None:
        return f"the recorded events do not bound p{behind}: {base.get('reason') or 'its spread is too large'}"
    low, high = (float(end) for end in ends)
    if high < WIDE_BASE * low or high <= 0.0:
        return ""
    factor = f"by a factor of {float(f'{high / low:.2g}'):,.0f}, " if low > 0.0 else ""
    return (
        f"the recorded events leave p open {factor}from {format_probability(low, low)} to "
        f"{format_probability(high, low)}{behind}"
    )


def describe_rate(result: Result) -> list[str]:
    """Return collisions per distance and time, or why they are not known."""
    rate = result.get("rate")
    if not isinstance(rate, dict):
        return [str(result.get("no_rate") or "no rate is known")]
    per_km, per_hour = (
        format_with_interval(rate[per], tuple(rate[f"interval_{per}"]), f"{what} {per.replace('_', ' ')}")
        for per, what in (("per_million_km", " collisions"), ("per_hour", ""))
    )
    return [f"{per_km}, {per_hour}", describe_human_contacts()]


def describe_method(result: Result) -> str:
    """Return the method with the settings that it used."""
    name, settings = str(result["method"]["name"]), dict(result["method"]["settings"])
    max_sim = (result.get("question") or {}).get("max_sim")
    if max_sim is not None:
        settings = {"max_sim": max_sim, **settings}
        if name in SIZED_BY_BUDGET:
            settings.pop("n", None)
    return f"{name} {', '.join(f'{key} = {value}' for key, value in settings.items())}".rstrip()


def describe_kind(kind: str) -> str:
    """Return a kind of crash in words."""
    return KIND_DESCRIPTIONS.get(kind, kind or "kind of crash not known")


def name_measure(name: str) -> str:
    """Return a measure with the unit of f, for an axis."""
    measure = MEASURES.get(name)
    if measure is None:
        return "measure f"
    return f"{name} [{measure.unit}]" if measure.unit else name


N_UNUSUAL = 3
"""Parameters of the most likely failure that are named at most."""
NAMED_SHARE = 1e-4
"""Share of p from which on a kind of crash is named."""


ENOUGH, MANY = 3.0, 300_000
"""Simulations over p that show with 95 % a region of failure as probable as all that was found; what they may cost."""
Row = tuple[str, str]
"""A line of the answer: its name, and its text."""


def print_report(report: Report, out: Path | None = None, details: bool = False) -> None:
    """Print the number, what it rests on, the most likely failure, and where the files are.

    Args:
        report: What to print.
        out: Folder of the run.
        details: Print everything: rates, kinds and severity with intervals, all parameters of the most likely failure.

    Example:
        >>> from rare_envs.study import Question, prepare, run
        >>> report = run(prepare(Question(env_id="rare_envs/CarFollowing-v0", method="mc", max_sim=100, horizon=1.0)))
        >>> print_report(report)  # doctest: +ELLIPSIS
        P[f <= 0] = 0.000e+00   rare_envs/CarFollowing-v0, ego idm
          95 % interval   0.000e+00 to ...
    """
    # markup off: P[f <= 0] and what warnings quote would be read as tags
    console = Console(highlight=False, soft_wrap=True, markup=False)
    estimate, question = report.estimate, report.study.question
    odds = f" (1 in {1 / estimate.p:,.0f} scenarios)" if 0 < estimate.p < 0.1 else ""
    console.print(
        f"P[f <= {estimate.gamma:g}] = {estimate.p:.3e}{odds}   "
        f"{question.env_id}, ego {question.ego}{report.average and f', {report.average}'}",
        style="bold",
    )
    ends = "{:.3e} to {:.3e}".format(*estimate.interval)
    if report.verdict is not None:
        ends += f" (each end is one-sided at {50 + 50 * estimate.confidence:g} %, for --max-p)"
    _print_rows(console, [(f"{100 * estimate.confidence:g} % interval", ends)])
    if report.verdict is not None:
        _print_rows(console, [("limit", str(report.verdict))], style="bold")
    name = report.study.base_name
    fixed = f"base distribution  no interval: {name!r} has no refits to events, so p takes it as the truth"
    for line in indent_lines(estimate.base_uncertainty or fixed):
        console.print(line)
    _print_rows(console, [row for each in report.other_bases for row in _describe_other_base(each)])
    _print_rows(console, [*_list_rates(report, details), *_list_effort(report, details), *_list_kinds(report, details)])
    _print_rows(console, _list_faults(report))
    for line in _describe_failure(report, details):
        console.print(f"  {line}")
    if isinstance(report.sensitivity, samplers.Sensitivity):
        for line in indent_lines(report.sensitivity):
            console.print(line)
    for warning in (*report.doubts_of_method, *report.doubts_of_f):
        console.print(f"warning: {warning}", style="yellow")
    for remark in report.remarks:
        console.print(f"remark: {remark}")
    for note in report.notes:
        console.print(f"note: {note}")
    if question.method != "mc" and estimate.p < estimate.unseen:
        n = float(f"{ENOUGH / estimate.p:.1g}") if estimate.p > ENOUGH / MANY else MANY
        console.print(f"check: --method mc --max-sim {n:.0f} does not rely on a search")
    if out is not None:
        names = ", ".join(path.name for path in sorted(out.iterdir()) if path.is_file())
        console.print(f"written to {out}: {names}")


def _print_rows(console: Console, rows: Iterable[Row], style: str | None = None) -> None:
    for name, text in rows:
        console.print(f"  {name:<15} {text}", style=style)


def _describe_other_base(answer: BaseAnswer) -> list[Row]:
    """Return p under another base that the question names, or why the simulations do not give it."""
    name, found = f"under {answer.base}", answer.found
    if found is None:
        advice = f"--base {answer.base} simulates there; a larger --max-sim gives more failing points"
        return [(name, f"not known: {answer.refused}"), ("", advice)]
    low, high = found.interval
    return [(name, f"{found.p:.3e} ({low:.1e} to {high:.1e}), {found.ess:.0f} effective failing points")]


def _list_rates(report: Report, details: bool) -> list[Row]:
    """Return collisions and injuries per million km beside those of people, or why they are not known."""
    rate, injuries = report.rate, report.injury_rate
    if rate is None:
        return [("collisions", report.no_rate)]
    per_km = format_with_interval(rate.per_million_km, rate.interval_per_million_km, " per million km")
    if details:
        per_hour = format_with_interval(rate.per_hour, rate.interval_per_hour, " per hour")
        rows = [("collisions", f"{per_km}, {per_hour}; {describe_human_contacts()}")]
        shares = sorted(rate.shares.items(), key=lambda part: -part[1])
        parts = ", ".join(f"{format_share(share)} {PART_NOUNS[name]}" for name, share in shares if share > 0)
        events = f"{format_rate(rate.frequency.per_km)} {EVENT_NOUNS.get(rate.scenario, 'events')} per km"
        rows.append(("", f"from {events}{f'; the uncertainty is {parts}' if parts else ''}"))
        return rows + ([] if injuries is None else [("", describe_injuries(injuries))])
    rows = [("collisions", f"{per_km}; {summarise_human_contacts()}")]
    if injuries is not None:
        per_km = format_with_interval(injuries.per_million_km, injuries.interval_per_million_km, " per million km")
        rows.append(("injuries", f"{per_km}, serious ones (MAIS 3+)"))
    return rows


def _list_effort(report: Report, details: bool) -> list[Row]:
    """Return the coefficient of variation, the method, and what the run took."""
    estimate, question = report.estimate, report.study.question
    cov = "not known" if math.isinf(estimate.cov) else f"{estimate.cov:.3f}"
    gain = explain_no_gain(estimate.p)
    if not math.isnan(estimate.gain):
        size = f"{estimate.gain:,.0f}" if estimate.gain >= 100 else f"{estimate.gain:.3g}"
        needed = estimate.gain * estimate.n_sim
        gain = f"{size} (plain Monte Carlo: about {needed:,.0f} simulations for the same c.o.v.)"
    run = f"{estimate.method.name}, seed {estimate.seed}, {describe_outcome(estimate.status, report.warnings)}"
    earlier = f" ({report.earlier_seconds:.0f} s before it was resumed)" if report.earlier_seconds else ""
    made_by = f"{question.core}{'' if question.device == 'cpu' else f' on {question.device}'}"
    time = f"{estimate.n_sim:,}{'' if details else ' simulations'} in {report.seconds:.1f} s{earlier} by {made_by}"
    chosen = [("chosen", estimate.choice)] if estimate.chose_another else []
    valid = ("valid", estimate.proviso)
    if details:
        return [("c.o.v.", cov), ("simulations", time), valid, ("gain", gain), ("method", run), *chosen]
    return [("c.o.v.", f"{cov}; gain {gain}"), ("method", f"{run}; {time}"), *chosen, valid]


def _list_kinds(report: Report, details: bool) -> list[Row]:
    """Return p by kind of crash, and how severe the collisions are."""
    shares, severity = report.kinds.shares, report.kinds.severity
    if details:
        kinds = []
        for kind, share in shares.items():
            low, high = share.interval
            numbers = f"{share.p:.1e} [{low:.1e}, {high:.1e}], {100 * share.of_failures:.3g} %"
            kinds.append(f"{numbers}: {KIND_DESCRIPTIONS.get(kind, kind)}")
        lines = str(severity or "").splitlines()
        return [*zip(["of which", *[""] * len(kinds)], kinds), *zip(["severity", *[""] * len(lines)], lines)]  # noqa: B905
    named = {kind: each.of_failures for kind, each in shares.items() if each.of_failures >= NAMED_SHARE}
    parts = [f"{100 * share:.3g} % {KIND_DESCRIPTIONS.get(kind, kind)}" for kind, share in named.items()]
    rare = len(shares) - len(named)
    parts += [f"{rare} rarer than {100 * NAMED_SHARE:g} %"] if rare else []
    rows = [("of which", "; ".join(parts))] if parts else []
    return rows + ([] if severity is None else [("severity", severity.summarise())])


def _list_faults(report: Report) -> list[Row]:
    """Return the statistics that normalise observations, and the scenarios on which the ego failed."""
    rows = [] if report.vec_normalize is None else [("observations", f"normalised by {report.vec_normalize}")]
    if report.faults:
        first = report.faults[0].reason
        rows.append(("faults", f"the ego failed twice on {len(report.faults)} scenarios; the first: {first}"))
        rows.append(("", f"{report.n_retried:,} more simulations were made to find them"))
    return rows


def _describe_failure(report: Report, details: bool) -> list[str]:
    """Return the most likely failure: how it ends, and what is unusual about it, or all of its parameters."""
    failures, space = report.estimate.failures, report.study.problem.space
    if not len(failures):
        return ["no failure found"]
    crash, f = report.crashes[0], f"f = {failures.f[0]:.3g}"
    what = "" if crash is None else summarise_crash(crash, report.study.problem.world.scenario.labels)
    found, brackets = f"most likely of {failures.total:,} failures found", "in brackets the central 90 %"
    if details:
        head = f"{found} ({f}; {brackets} of ordinary scenarios):"
        return [head, *([f"  {what}"] if what else []), *_list_parameters(space, failures.x[0])]
    unusual = _list_unusual(space, failures.x[0])
    if unusual:
        unusual += f" ({brackets} of ordinary scenarios)"
    else:
        but = " but drivers' weights or noise" if max(space.sizes) > MAX_SHOWN else ""
        unusual = f"nothing beyond the central 90 % of ordinary scenarios{but}"
    return [f"{found}: {what or f}", f"  unusual in it: {unusual}"]


def summarise_crash(crash: dict[str, Any], labels: tuple[str, ...]) -> str:
    """Return who ran into whom, how fast, and the risk of injury, in words; `labels` are those of the vehicles."""
    who = ["the edge of the road" if one < 0 else labels[one] for one in crash["vehicles"]]
    speeds = f"{crash['impact_speed']:.1f} m/s at contact, delta-v {max(crash['delta_v']):.1f} m/s"
    return f"{who[0]} runs into {who[1]}: {speeds}, serious injury {100 * max(crash['injury_risk']):.2g} %"


def _list_unusual(space: ScenarioSpace, x: FloatArray) -> str:
    """Return the parameters of a scenario x (d,) that are outside the central 90 % of ordinary scenarios.

    The furthest comes first, by the width of that range. Values of large blocks (weights, noise) are not among them.
    """
    columns = list_columns(space)
    low, high = find_ordinary_range(draw_ordinary(space))
    beyond = np.maximum(low - x, x - high) / np.maximum(high - low, 1e-12)
    shown = [j for j in np.argsort(-beyond) if beyond[j] > 0 and columns[j].shown]
    named = [
        f"{columns[j].name} {format_value(x[j])} {columns[j].unit} "
        f"[{format_value(low[j], 1)} to {format_value(high[j], 1)}]"
        for j in shown[:N_UNUSUAL]
    ]
    return ", ".join([*named, *([f"{len(shown) - N_UNUSUAL} more"] if len(shown) > N_UNUSUAL else [])])


def _list_parameters(space: ScenarioSpace, x: FloatArray) -> list[str]:
    """Return the parameters of a scenario x (d,), each beside the range that is ordinary; large blocks in summary."""
    ordinary = draw_ordinary(space)
    normal = space.columns(space.to_standard_normal(np.vstack((x, ordinary))))
    own, usual, lines = space.columns(x[None]), space.columns(ordinary), []
    for name, size, unit in zip(space.names, space.sizes, space.units, strict=True):
        if size <= MAX_SHOWN:
            (low,), (high,) = find_ordinary_range(usual[name].reshape(-1, 1))  # of all values of a block
            values = " ".join(f"{format_value(value):>8}" for value in own[name].flat)
            text = f"{values} {unit:<4} [{format_value(low, 1)} to {format_value(high, 1)}]"
        else:
            text = _summarise_block(name, own[name][0], usual[name], normal[name])
        lines.append(f"  {name:<15} {text}")
    return lines


def _summarise_block(name: str, values: FloatArray, ordinary: FloatArray, normal: FloatArray) -> str:
    """Return a summary of a block of many values."""
    distance = np.linalg.norm(normal, axis=1)
    low, high = np.quantile(distance[1:], (0.05, 0.95))
    spread = (values - ordinary.mean(axis=0)) / np.maximum(ordinary.std(axis=0), 1e-12)
    furthest = int(np.abs(spread).argmax())
    return (
        f"{len(values):,} values, {distance[0]:.2f} standard deviations from their mean [{low:.1f} to {high:.1f}], "
        f"most in {name}[{furthest}], {spread[furthest]:+.1f}"
    )
