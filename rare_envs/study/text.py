"""Text of an answer: the number, what it rests on, rates, crashes; on the terminal and in the report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

import samplers
from rare_envs.exposure import (
    CollisionRate,
    FurtherEvents,
    RateInterval,
    TotalRate,
    VarianceShare,
    describe_human_contacts,
    summarise_human_contacts,
)
from rare_envs.measures import MEASURES
from rare_envs.study.columns import MAX_SHOWN, draw_ordinary, find_ordinary_range, format_value, list_columns
from rare_envs.study.modes import KIND_DESCRIPTIONS
from rare_envs.study.report import Report
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
    return [_format_decimal(value) if decimal else _format_power(value) for value in values]


def _format_power(value: float) -> str:
    return f"{value:.1e}" if value > 0 and math.isfinite(value) else f"{value:g}"


def _format_decimal(value: float) -> str:
    if value <= 0 or not math.isfinite(value):
        return f"{value:g}"
    if value >= LARGE:
        return f"{round(value, 1 - math.floor(math.log10(value))):,.0f}"
    return f"{value:#.2g}".rstrip(".")


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


def name_events(name: str) -> str:
    """Return the events of a scenario, in the plural."""
    return EVENT_NOUNS.get(name, "events")


def describe_parts(rate: CollisionRate) -> str:
    """Return the parts of the uncertainty of one rate, the largest first; empty where it is not determined."""
    parts = sorted(rate.shares.items(), key=lambda part: -part[1])
    return ", ".join(f"{format_share(share)} {PART_NOUNS[name]}" for name, share in parts if share > 0)


def describe_injuries(rate: CollisionRate | TotalRate) -> str:
    """Return a rate of serious injuries with its interval, in words."""
    return "serious injuries (MAIS 3+) " + format_with_interval(
        rate.per_million_km, rate.interval_per_million_km, " per million km", f"{100 * rate.confidence:g} %: "
    )


def describe_sources(shares: tuple[VarianceShare, ...]) -> str:
    """Return the sources of the uncertainty of a total, the largest first."""
    return ", ".join(f"{format_share(each.share)} {name_source(each)}" for each in shares)


def describe_further_events(needed: FurtherEvents) -> str:
    """Return how many further events would halve the uncertainty, in words."""
    events = name_events(needed.scenario)
    if needed.number is not None:
        return f"about {format_rate(needed.number)} further recorded {events} would halve it"
    return f"further {events} alone would not halve it; about {format_rate(needed.own)} would halve their own part"


def describe_uncertainty(total: TotalRate, recorded: dict[str, int]) -> str:
    """Return what the uncertainty of a total comes from; empty if it is not known.

    Where a rate is not determined, the shares are those of the sum of the others.
    """
    parts = []
    if total.shares:
        whole = len(total.determined) == len(total.rates)
        of_what = "the uncertainty" if whole else "the uncertainty of the determined part"
        parts.append(f"{of_what} is {describe_sources(total.shares)}")
        needed = total.further_events(recorded)
        parts += [] if needed is None else [f"{describe_further_events(needed)} (a spread falls with 1 / sqrt(events))"]
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


def _describe_ends(result: Result) -> str:
    """Return why the interval has another confidence than usual; empty where it has not."""
    if not isinstance(result.get("gate"), dict):
        return ""
    return f"; each end is one-sided at {50 + 50 * float(result['confidence']):g} %, for the limit of --max-p"


def describe_intervals(result: Result) -> list[tuple[str, str, str]]:
    """Return the intervals of p: name, ends, and what each holds."""
    percent, p = f"{100 * float(result['confidence']):g} %", float(result["p"])
    low, high = (float(end) for end in result["interval"])
    rows = [
        (
            f"{percent}, sampling",
            f"{format_probability(low, p)} to {format_probability(high, p)}",
            "error of a finite number of simulations; the model of traffic taken as true" + _describe_ends(result),
        )
    ]
    base = result.get("base_uncertainty")
    if isinstance(base, dict):
        ends = base.get("interval") or [None, None]
        text = (
            f"{format_probability(ends[0], p)} to {format_probability(ends[1], p)}"
            if ends[0] is not None
            else "not determined"
        )
        rows.append(
            (
                f"{100 * float(base.get('confidence') or 0.95):g} %, base distribution",
                text,
                f"what the recorded events allow ({base.get('fitted_to', '')}); predictive mean "
                f"{format_probability(base.get('expected'), p)}",
            )
        )
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


class Row(NamedTuple):
    """A line of the answer."""

    name: str
    text: str


def list_rows(report: Report) -> list[Row]:
    """Return the lines between the intervals and the most likely failure."""
    estimate = report.estimate
    return [
        *_describe_rate(report),
        Row("c.o.v.", f"{format_cov(estimate)}; gain {format_gain(estimate)}"),
        Row("method", f"{describe_run(report)}; {estimate.n_sim:,} simulations in {describe_time(report)}"),
        *([Row("chosen", estimate.choice)] if estimate.chose_another else []),
        Row("valid", estimate.proviso),
        *_describe_kinds(report),
        *_describe_severity(report),
    ]


def format_cov(estimate: samplers.Estimate) -> str:
    """Return the coefficient of variation."""
    return "not known" if math.isinf(estimate.cov) else f"{estimate.cov:.3f}"


def format_gain(estimate: samplers.Estimate) -> str:
    """Return the gain over plain Monte Carlo, and the simulations that it stands for."""
    if math.isnan(estimate.gain):
        return explain_no_gain(estimate.p)
    needed = estimate.gain * estimate.n_sim
    gain = f"{estimate.gain:,.0f}" if estimate.gain >= 100 else f"{estimate.gain:.3g}"
    return f"{gain} (plain Monte Carlo: about {needed:,.0f} simulations for the same c.o.v.)"


def describe_run(report: Report) -> str:
    """Return the method, its seed and how it ended."""
    estimate = report.estimate
    return f"{estimate.method.name}, seed {estimate.seed}, {describe_outcome(estimate.status, report.warnings)}"


def describe_time(report: Report) -> str:
    """Return the wall time, how much of it was before an interruption, and what made the rollouts."""
    text = f"{report.seconds:.1f} s"
    earlier = f" ({report.earlier_seconds:.0f} s before it was resumed)" if report.earlier_seconds else ""
    question = report.study.question
    return f"{text}{earlier} by {question.core}{'' if question.device == 'cpu' else f' on {question.device}'}"


def summarise_crash(crash: dict[str, Any], labels: tuple[str, ...]) -> str:
    """Return who ran into whom, how fast, and the risk of injury, in words; `labels` are those of the vehicles."""
    who = ["the edge of the road" if one < 0 else labels[one] for one in crash["vehicles"]]
    speeds = f"{crash['impact_speed']:.1f} m/s at contact, delta-v {max(crash['delta_v']):.1f} m/s"
    return f"{who[0]} runs into {who[1]}: {speeds}, serious injury {100 * max(crash['injury_risk']):.2g} %"


def list_unusual(report: Report) -> str:
    """Return the parameters of the most likely failure that are outside the central 90 % of ordinary scenarios.

    The furthest comes first, by the width of that range. Values of large blocks (weights, noise) are not among them.
    """
    space, x = report.study.problem.space, report.estimate.failures.x[0]
    columns = list_columns(space)
    low, high = find_ordinary_range(draw_ordinary(space))
    beyond = np.maximum(low - x, x - high) / np.maximum(high - low, 1e-12)
    shown = [j for j in np.argsort(-beyond) if beyond[j] > 0 and columns[j].shown]

    def describe(j: int) -> str:
        ends = f"[{format_value(low[j], 1)} to {format_value(high[j], 1)}]"
        return f"{columns[j].name} {format_value(x[j])} {columns[j].unit} {ends}"

    named = [describe(j) for j in shown[:N_UNUSUAL]]
    more = [f"{len(shown) - N_UNUSUAL} more"] if len(shown) > N_UNUSUAL else []
    return ", ".join([*named, *more])


def describe_failure(report: Report) -> list[str]:
    """Return the most likely failure: how it ends, and what is unusual about it."""
    failures = report.estimate.failures
    if not len(failures):
        return ["no failure found"]
    crash, labels = report.crashes[0], report.study.problem.world.scenario.labels
    what = f"f = {failures.f[0]:.3g}" if crash is None else summarise_crash(crash, labels)
    unusual = list_unusual(report)
    large = any(size > MAX_SHOWN for size in report.study.problem.space.sizes)
    none = "nothing beyond the central 90 % of ordinary scenarios" + (" but drivers' weights or noise" if large else "")
    return [
        f"most likely of {failures.total:,} failures found: {what}",
        f"  unusual in it: {f'{unusual} (in brackets the central 90 % of ordinary scenarios)' if unusual else none}",
    ]


def _describe_rate(report: Report) -> list[Row]:
    """Return collisions and injuries per million km, or why they are not known."""
    rate, injuries = report.rate, report.injury_rate
    if rate is None:
        return [Row("collisions", report.no_rate)]
    rows = [Row("collisions", f"{_describe_per_km(rate)}; {summarise_human_contacts()}")]
    if injuries is not None:
        rows.append(Row("injuries", f"{_describe_per_km(injuries)}, serious ones (MAIS 3+)"))
    return rows


def _describe_per_km(rate: CollisionRate) -> str:
    return format_with_interval(rate.per_million_km, rate.interval_per_million_km, " per million km")


def _describe_kinds(report: Report) -> list[Row]:
    """Return the shares of p by kind of crash."""
    shares = report.kinds.shares
    named = {kind: each.of_failures for kind, each in shares.items() if each.of_failures >= NAMED_SHARE}
    parts = [f"{100 * share:.3g} % {KIND_DESCRIPTIONS.get(kind, kind)}" for kind, share in named.items()]
    rare = len(shares) - len(named)
    parts += [f"{rare} rarer than {100 * NAMED_SHARE:g} %"] if rare else []
    return [Row("of which", "; ".join(parts))] if parts else []


def _describe_severity(report: Report) -> list[Row]:
    """Return the most severe collisions whose probability is known."""
    severity = report.kinds.severity
    if severity is None:
        return []
    return [Row("severity", severity.summarise())]


ENOUGH, MANY = 3.0, 300_000
"""Simulations over p that show with 95 % a region of failure as probable as all that was found; what they may cost."""


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
    low, high = estimate.interval
    console.print(
        f"P[f <= {estimate.gamma:g}] = {estimate.p:.3e}{_format_odds(estimate.p)}   "
        f"{question.env_id}, ego {question.ego}{report.average and f', {report.average}'}",
        style="bold",
    )
    limited = report.verdict is not None
    ends = f" (each end is one-sided at {50 + 50 * estimate.confidence:g} %, for --max-p)" if limited else ""
    console.print(f"  {f'{100 * estimate.confidence:g} % interval':<15} {low:.3e} to {high:.3e}{ends}")
    if limited:
        console.print(f"  {'limit':<15} {report.verdict}", style="bold")
    for line in indent_lines(estimate.base_uncertainty or _describe_fixed_base(report)):
        console.print(line)
    _print_other_bases(console, report)
    if details:
        _print_details(console, report)
    else:
        _print_rows(console, list_rows(report))
    _print_rows(console, _list_faults(report))
    if details:
        _print_failure(console, report)
    else:
        for line in describe_failure(report):
            console.print(f"  {line}")
    if isinstance(report.sensitivity, samplers.Sensitivity):
        for line in indent_lines(report.sensitivity):
            console.print(line)
    for warning in (*(() if report.is_exact_bound else estimate.warnings), *report.doubts_of_f):
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


def _print_rows(console: Console, rows: list[Row]) -> None:
    for name, text in rows:
        console.print(f"  {name:<15} {text}")


def _print_details(console: Console, report: Report) -> None:
    """Print rates, effort and kinds of crash with their intervals."""
    estimate = report.estimate
    _print_rate(console, report)
    _print_rows(
        console,
        [
            Row("c.o.v.", format_cov(estimate)),
            Row("simulations", f"{estimate.n_sim:,} in {describe_time(report)}"),
            Row("valid", estimate.proviso),
            Row("gain", format_gain(estimate)),
            Row("method", describe_run(report)),
            *([Row("chosen", estimate.choice)] if estimate.chose_another else []),
        ],
    )
    _print_kinds(console, report)


def _list_faults(report: Report) -> list[Row]:
    """Return the statistics that normalise observations, and the scenarios on which the ego failed."""
    rows = []
    if report.vec_normalize is not None:
        rows.append(Row("observations", f"normalised by {report.vec_normalize}"))
    if report.faults:
        first = report.faults[0].reason
        rows.append(Row("faults", f"the ego failed twice on {len(report.faults)} scenarios; the first: {first}"))
        rows.append(Row("", f"{report.n_retried:,} more simulations were made to find them"))
    return rows


def _describe_fixed_base(report: Report) -> str:
    """Return that nothing is known of the error of the base distribution."""
    name = report.study.base_name
    return f"base distribution  no interval: {name!r} has no refits to events, so p takes it as the truth"


def _print_other_bases(console: Console, report: Report) -> None:
    """Print p under the other bases that the question names, or why the simulations do not give it."""
    for each in report.other_bases:
        if each.found is None:
            console.print(f"  {f'under {each.base}':<15} not known: {each.refused}")
            console.print(
                f"  {'':<15} --base {each.base} simulates there; a larger --max-sim gives more failing points"
            )
        else:
            low, high = each.found.interval
            console.print(
                f"  {f'under {each.base}':<15} {each.found.p:.3e} ({low:.1e} to {high:.1e}), "
                f"{each.found.ess:.0f} effective failing points"
            )


def _print_rate(console: Console, report: Report) -> None:
    """Print collisions per million km and per hour beside those of people, or why they are not known."""
    rate = report.rate
    if rate is None:
        console.print(f"  {'collisions':<15} {report.no_rate}")
        return
    console.print(
        f"  {'collisions':<15} "
        f"{format_with_interval(rate.per_million_km, rate.interval_per_million_km, ' per million km')}, "
        f"{format_with_interval(rate.per_hour, rate.interval_per_hour, ' per hour')}; {describe_human_contacts()}"
    )
    events = f"{format_rate(rate.frequency.per_km)} {name_events(rate.scenario)} per km"
    parts = describe_parts(rate)
    console.print(f"  {'':<15} from {events}{f'; the uncertainty is {parts}' if parts else ''}")
    if report.injury_rate is not None:
        console.print(f"  {'':<15} {describe_injuries(report.injury_rate)}")


def _print_kinds(console: Console, report: Report) -> None:
    """Print p by kind of crash, and how severe the collisions are."""
    for number, (kind, share) in enumerate(report.kinds.shares.items()):
        low, high = share.interval
        share_of_p = f"{share.p:.1e} [{low:.1e}, {high:.1e}], {100 * share.of_failures:.3g} %"
        text = f"{share_of_p}: {KIND_DESCRIPTIONS.get(kind, kind)}"
        console.print(f"  {'of which' if number == 0 else '':<15} {text}")
    for number, line in enumerate(str(report.kinds.severity or "").splitlines()):
        console.print(f"  {'severity' if number == 0 else '':<15} {line}")


def _format_odds(p: float) -> str:
    """Return a small probability in words."""
    return f" (1 in {1 / p:,.0f} scenarios)" if 0 < p < 0.1 else ""


def _print_failure(console: Console, report: Report) -> None:
    """Print the most likely failure beside the range that is ordinary for each parameter."""
    failures, space = report.estimate.failures, report.study.problem.space
    if not len(failures):
        console.print("  no failure found")
        return
    ordinary = draw_ordinary(space)
    console.print(
        f"  most likely of {failures.total:,} failures found (f = {failures.f[0]:.3g}; "
        "in brackets the central 90 % of ordinary scenarios):"
    )
    if report.crashes[0] is not None:
        console.print(f"    {summarise_crash(report.crashes[0], report.study.problem.world.scenario.labels)}")
    normal = space.columns(space.to_standard_normal(np.vstack((failures.x[:1], ordinary))))
    likeliest, usual = space.columns(failures.x[:1]), space.columns(ordinary)
    for j, name in enumerate(space.names):
        if space.sizes[j] <= MAX_SHOWN:
            (low,), (high,) = find_ordinary_range(usual[name].reshape(-1, 1))  # of all values of a block
            values = " ".join(f"{format_value(value):>8}" for value in likeliest[name].flat)
            console.print(
                f"    {name:<15} {values} {space.units[j]:<4} [{format_value(low, 1)} to {format_value(high, 1)}]"
            )
        else:
            console.print(f"    {name:<15} {_summarise_block(name, likeliest[name][0], usual[name], normal[name])}")


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
