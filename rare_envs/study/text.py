"""Text of an answer: the number, what it rests on, rates, crashes; on the terminal and in the report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

import samplers
from rare_envs import exposure, people
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.measures import MEASURES
from rare_envs.plugins import clean_text
from rare_envs.study.episodes import MAX_SHOWN, draw_ordinary, find_ordinary_range, format_value, list_columns
from rare_envs.study.events import MODEL, NO_HEADWAY_RULE, EventRate
from rare_envs.study.failures import KIND_DESCRIPTIONS
from rare_envs.study.replay import name_parties
from rare_envs.study.report import Report
from samplers.output import indent_lines
from samplers.problem import FloatArray
from samplers.sample import describe_outcome

EVENT_NOUNS = {
    "cut_in": "cut-ins",
    "stop": "stops of the lead",
    "slowing": "slowings of the lead",
    "hard_brake": "brakings",
    "car_following": "new leaders",
}
"""Events, and those of scenarios, in the plural."""
SOURCE_NOUNS = {"counts": "event counts", "sampling": "simulation"}
LARGE, SMALL, SMALL_BESIDE = 99.5, 0.01, 0.001
"""Rates from which whole numbers are shown, and below which powers of ten: alone, and beside a rate above `SMALL`."""


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


def format_rate(value: float) -> str:
    """Return a rate with two digits."""
    return format_alike(value)[0]


def format_with_interval(value: float, interval: exposure.RateInterval, unit: str = "", level: str = "") -> str:
    """Return a rate with its interval, all numbers in one form, or with what it is below."""
    if interval[0] <= 0:  # with an upper end alone the value may be smaller by any power
        return f"{format_rate(value)}{unit} ({level}below {format_rate(interval[1])})"
    middle, low, high = format_alike(value, *interval)
    return f"{middle}{unit} ({level}{low} to {high})"


def format_share(share: float) -> str:
    """Return a share in per cent: whole, or one digit below 1 %."""
    return f"{100 * share:.0f} %" if share >= 0.01 else f"{100 * share:.1g} %"


def name_scenario(name: str) -> str:
    """Return the name of a scenario in words: "hard brake"."""
    return "cut-in" if name == "cut_in" else name.replace("_", " ")


def describe_injuries(rate: exposure.CollisionRate | exposure.TotalRate) -> str:
    """Return a rate of serious injuries with its interval, in words."""
    return "serious injuries (MAIS 3+) " + format_with_interval(
        rate.per_million_km, rate.interval_per_million_km, " per million km", f"{100 * rate.confidence:g} %: "
    )


def describe_people(counted: people.HumanBenchmark | None) -> str:
    """Return people's contacts per million km with their interval."""
    if counted is None:
        return "not counted"
    return format_with_interval(counted.per_million_km, counted.interval_per_million_km)


def describe_model(each: EventRate) -> str:
    """Return the model's contacts per million km, with and without headway rule, and how far it is from people."""
    known, scores = each.calibration, ""
    if known is not None:
        counts = [known.per_million_km(name) for name in (MODEL, NO_HEADWAY_RULE)]
        scores = " and ".join(dict.fromkeys(format_alike(*(count.p for count in counts))))
        if not any(count.p for count in counts):
            scores = f"below {format_rate(max(count.high for count in counts))}"
    return ": ".join(filter(None, (scores, each.uncalibrated)))


def list_uncalibrated(events: Sequence[EventRate]) -> str:
    """Return the kinds of event without a calibrated rate; empty where there is none."""
    return ", ".join(EVENT_NOUNS.get(each.event, each.event) for each in events if each.uncalibrated)


def describe_parts(shares: Mapping[str, float], unresolved: Mapping[str, float]) -> str:
    """Return the shares of strata in a rate, the largest first, and the upper ends of those that are not resolved.

    "of which unseen 92 %, looked 8 %", or "of which unseen 100 %; looked is not resolved, below 2.6".
    """
    ordered = sorted(shares.items(), key=lambda part: -part[1])
    known = ", ".join(f"{name} {format_share(share)}" for name, share in ordered if name not in unresolved)
    vague = [f"{name} is not resolved, below {format_rate(high)}" for name, high in unresolved.items()]
    return "; ".join([*([f"of which {known}"] if known else []), *vague])


def tabulate(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of words as lines with columns as wide as their longest word."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{word:<{width}}" for word, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def tabulate_events(events: Sequence[EventRate]) -> list[str]:
    """Return a table of the rates of events per million km, each beside people and the human driver model in it."""
    rows = [("", "per km", "per event", "per million km", "people in them", "human model")]
    for each in events:
        rate, resolved = each.rate, each.event not in each.unresolved
        found = rate.p if rate.interval is None or (rate.p > 0 and resolved) else rate.interval[1]
        p = f"{'' if rate.p > 0 and resolved else 'below '}{min(found / each.share, 1.0):.1e}"
        numbers = format_rate(rate.frequency.per_km * each.share), p
        ends = rate.interval_per_million_km
        ego = format_with_interval(rate.per_million_km, ends) if resolved else f"below {format_rate(ends[1])}"
        name = EVENT_NOUNS.get(each.event, each.event)
        rows.append((name, *numbers, ego, describe_people(each.people), describe_model(each)))
    head, *lines = tabulate(rows)
    vague = ({name: end for name, end in each.unresolved.items() if name != each.event} for each in events)
    below = (describe_parts(each.parts, ends) for each, ends in zip(events, vague, strict=True))
    parts = ([f"  {more}"] if more else [] for more in below)
    return [head, *(line for row, more in zip(lines, parts, strict=True) for line in (row, *more))]


def describe_columns() -> str:
    """Return what the columns of people and of the human driver model are."""
    return (
        f"{MODEL} and {NO_HEADWAY_RULE} in the same events; within a factor {people.CALIBRATED_WITHIN:g} of people's "
        "interval a rate is calibrated (people: 100-Car, contacts at any speed)"
    )


def describe_uncertainty(total: exposure.TotalRate) -> str:
    """Return what the uncertainty of a total comes from; empty if it is not known."""
    parts = []
    if total.shares:
        whole = len(total.determined) == len(total.rates)
        of_what = "the uncertainty" if whole else "the uncertainty of the determined part"
        sources = ", ".join(f"{format_share(each.share)} {name_source(each)}" for each in total.shares)
        parts.append(f"{of_what} is {sources}")
    for rate in (each for each in total.rates if not each.determined):
        high = format_rate(rate.interval_per_million_km[1])
        parts.append(f"{name_scenario(rate.scenario)} is not determined, and adds {high} to the upper end")
    return "; ".join(parts)


def name_source(each: exposure.VarianceShare) -> str:
    """Return a source of uncertainty in words, such as "the cut-in distribution"."""
    scenario = name_scenario(each.scenario)
    nouns = {"base": f"the {scenario} distribution", "site": f"{scenario} at other sites", **SOURCE_NOUNS}
    return nouns[each.source]


Result = Mapping[str, Any]
WIDE_BASE = 10.0
"""Ratio of the ends of the interval of the base distribution from which on the report warns of it."""


def format_probability(p: float | None, like: float | None = None) -> str:
    """Return a probability for people: as a percentage, or in powers of ten where it is small."""
    if p is None or not math.isfinite(p):
        return "not known"
    if p <= 0:
        return "0"
    if (p if like is None else like) >= 0.001:
        return f"{100 * p:.{2 if p < 0.99 else 4}g} %"
    mantissa, _, exponent = f"{p:.1e}".partition("e")
    return f"{mantissa} × 10{str(int(exponent)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"


def explain_no_gain(p: float, resolved: bool) -> str:
    """Return why there is no gain over Monte Carlo; of sums whether all strata are resolved."""
    if p <= 0:
        return "not known, as nothing that failed counts in p"
    if not resolved:
        return "not known, as a stratum is not resolved"
    return "none, as every scenario fails" if p >= 1 else "not known, as the c.o.v. is 1 or more"


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


def describe_kind(kind: str) -> str:
    """Return a kind of crash in words."""
    return KIND_DESCRIPTIONS.get(kind, kind or "kind of crash not known")


def name_measure(name: str) -> str:
    """Return a measure with the unit of f, for an axis."""
    measure = MEASURES.get(name)
    if measure is None:
        return "measure f"
    return f"{name} [{measure.unit}]" if measure.unit else name


class CleanConsole(Console):
    """A terminal that shows text clean; markup is to be off, as which P[f <= 0] would be read."""

    def render_str(self, text: str, **how: Any) -> Text:
        """Return a text to show."""
        return super().render_str(clean_text(text), **how)


N_UNUSUAL = 3
"""Parameters of the most likely failure that are named at most."""
NAMED_SHARE = 1e-4
"""Share of p from which on a kind of crash is named."""


ENOUGH, MANY = 30, 1_000_000
"""Failures that a run by plain Monte Carlo is to find, and simulations that are advised for it at most."""
Row = tuple[str, str]
"""A line of the answer: its name, and its text."""


def print_report(report: Report, out: Path | None = None, details: bool = False) -> None:
    """Print the number, what it rests on, the most likely failure, and where the files are; with details everything."""
    console = CleanConsole(highlight=False, soft_wrap=True, markup=False)
    estimate, question = report.estimate, report.study.question
    odds = f" (1 in {1 / estimate.p:,.0f} scenarios)" if 0 < estimate.p < 0.1 else ""
    average = f", {report.average}" if report.average else ""
    head = f"{estimate.headline}{odds}   {question.env_id}, ego {question.ego}{average}"
    console.print(head, style="bold")
    ends = "{:.3e} to {:.3e}".format(*estimate.interval)
    if report.verdict is not None:
        ends += f" (each end is one-sided at {50 + 50 * estimate.confidence:g} %, for the limit)"
    console.print(_write_row(f"{100 * estimate.confidence:g} % interval", ends))
    if estimate.sequence is not None:
        looks = "{:.3e} to {:.3e}, as the run stopped on what it saw".format(*estimate.sequence)
        console.print(_write_row("at every look", looks))
    if report.verdict is not None:
        console.print(_write_row("limit", str(report.verdict)), style="bold")
    fixed = f"no interval: {report.study.base_name!r} has no refits to events, so p takes it as the truth"
    lines = list(indent_lines(estimate.base_uncertainty or f"base distribution  {fixed}"))
    parts = [("strata" if number == 0 else "", str(part)) for number, part in enumerate(estimate.parts)]
    for rows in (parts, _list_other_bases(report), _list_rates(report, details), _list_effort(report, details)):
        lines += [_write_row(*row) for row in rows]
    lines += [_write_row(*row) for row in (*_list_kinds(report, details), *_list_faults(report))]
    lines += [f"  {line}" for line in _describe_failure(report, details)]
    lines += indent_lines(report.sensitivity) if isinstance(report.sensitivity, samplers.Sensitivity) else ()
    for line in lines:
        console.print(line)
    for warning in (*report.doubts_of_method, *report.doubts_of_f):
        console.print(f"warning: {warning}", style="yellow")
    lines = [f"remark: {remark}" for remark in report.remarks] + [f"note: {note}" for note in report.notes]
    if question.method != "mc" and ENOUGH / MANY <= estimate.p < estimate.unseen:
        place = 10 ** math.floor(math.log10(ENOUGH / estimate.p))
        n = place * math.ceil(ENOUGH / estimate.p / place)
        lines.append(f"check: --method mc --max-sim {n} does not rely on a search")
    if out is not None:
        names = ", ".join(path.name for path in sorted(out.iterdir()) if path.is_file())
        lines.append(f"written to {out}: {names}")
    for line in lines:
        console.print(line)


def _write_row(name: str, text: str) -> str:
    return f"  {name:<15} {text}"


def _list_other_bases(report: Report) -> Iterator[Row]:
    """Yield p under the other bases that the question names, or why the simulations do not give it."""
    for base, found in report.other_bases.items():
        if isinstance(found, str):
            yield f"under {base}", f"not known: {found}"
            yield "", f"--base {base} simulates there; a larger --max-sim gives more failing points"
        else:
            low, high = found.interval
            ends = f"{found.p:.3e} ({low:.1e} to {high:.1e})"
            yield f"under {base}", f"{ends}, {found.ess:.0f} effective failing points"


def _list_rates(report: Report, details: bool) -> Iterator[Row]:
    """Yield collisions and injuries per million km beside those of people, or why they are not known."""
    rate, injuries, unit = report.rate, report.injury_rate, " per million km"
    if rate is None:
        yield "collisions", report.no_rate
        return
    per_km = format_with_interval(rate.per_million_km, rate.interval_per_million_km, unit)
    yield "collisions", per_km
    yield from (("", line) for line in tabulate_events(report.events))
    if details:
        events = f"{format_rate(rate.frequency.per_km)} {EVENT_NOUNS.get(rate.scenario, 'events')} per km"
        yield "", "; ".join(filter(None, [f"from {events}", describe_uncertainty(exposure.TotalRate((rate,)))]))
    if injuries is not None and details:
        yield "", describe_injuries(injuries)
    elif injuries is not None:
        ends = format_with_interval(injuries.per_million_km, injuries.interval_per_million_km, unit)
        yield "injuries", f"{ends}, serious ones (MAIS 3+)"


def _list_effort(report: Report, details: bool) -> Iterator[Row]:
    """Yield the coefficient of variation, the method, and what the run took."""
    estimate, question = report.estimate, report.study.question
    cov = "not known" if math.isinf(estimate.cov) else f"{estimate.cov:.3f}"
    gain = explain_no_gain(estimate.p, all(part.resolved for part in estimate.parts))
    if not math.isnan(estimate.gain):
        size = f"{estimate.gain:,.0f}" if estimate.gain >= 100 else f"{estimate.gain:.3g}"
        needed = estimate.gain * estimate.n_sim
        gain = f"{size} (plain Monte Carlo: about {needed:,.0f} simulations for the same c.o.v.)"
    run = f"{estimate.method.name}, seed {estimate.seed}, {describe_outcome(estimate.status, report.warnings)}"
    earlier = f" ({report.earlier_seconds:.0f} s before it was resumed)" if report.earlier_seconds else ""
    made_by = f"{question.core}{'' if question.device == 'cpu' else f' on {question.device}'}"
    time = f"{estimate.n_sim:,}{'' if details else ' simulations'} in {report.seconds:.1f} s{earlier} by {made_by}"
    rows = {"c.o.v.": f"{cov}; gain {gain}", "method": f"{run}; {time}"}
    if details:
        rows = {"c.o.v.": cov, "simulations": time, "unseen": estimate.proviso, "gain": gain, "method": run}
    chosen = {"chosen": estimate.choice} if estimate.chosen is not None and estimate.chosen.unusual else {}
    yield from ({**rows, **chosen} if details else {**rows, **chosen, "unseen": estimate.proviso}).items()


def _list_kinds(report: Report, details: bool) -> Iterator[Row]:
    """Yield p by kind of crash, and how severe the collisions are."""
    shares, severity, rows = report.kinds.shares, report.kinds.severity, dict[str, list[str]]()
    if details:
        for kind, share in shares.items():
            low, high = share.interval
            numbers = f"{share.p:.1e} [{low:.1e}, {high:.1e}], {100 * share.of_failures:.3g} %"
            rows.setdefault("of which", []).append(f"{numbers}: {KIND_DESCRIPTIONS.get(kind, kind)}")
        rows["severity"] = str(severity or "").splitlines()
    else:
        named = {kind: each.of_failures for kind, each in shares.items() if each.of_failures >= NAMED_SHARE}
        parts = [f"{100 * share:.3g} % {KIND_DESCRIPTIONS.get(kind, kind)}" for kind, share in named.items()]
        rare = len(shares) - len(named)
        parts += [f"{rare} rarer than {100 * NAMED_SHARE:g} %"] if rare else []
        rows["of which"] = ["; ".join(parts)] if parts else []
        rows["severity"] = [] if severity is None else [severity.summarise()]
    for name, lines in rows.items():
        yield from ((name if number == 0 else "", line) for number, line in enumerate(lines))


def _list_faults(report: Report) -> Iterator[Row]:
    """Yield the statistics that normalise observations, and the scenarios on which the ego failed."""
    if report.vec_normalize is not None:
        yield "observations", f"normalised by {report.vec_normalize}"
    if report.faults:
        first = report.faults[0].reason
        yield "faults", f"the ego failed twice on {len(report.faults)} scenarios; the first: {first}"
        yield "", f"{report.n_retried:,} more simulations were made to find them"


def _describe_failure(report: Report, details: bool) -> Iterator[str]:
    """Yield the most likely failure: how it ends, and what is unusual about it, or all of its parameters."""
    failures, space = report.estimate.failures, report.study.problem.space
    if not len(failures):
        yield "no failure found"
        return
    with_outcome = np.flatnonzero(~np.isnan(failures.f))
    k = int(with_outcome[0]) if len(with_outcome) else 0
    crash, f = report.crashes[k], f"f = {failures.f[k]:.3g}" if len(with_outcome) else "the ego failed"
    what = ""
    if crash is not None:
        who, whom = name_parties(crash, report.study.problem.world.scenario.labels)
        speeds = f"{crash['impact_speed']:.1f} m/s at contact, delta-v {max(crash['delta_v']):.1f} m/s"
        what = f"{who} runs into {whom}: {speeds}, serious injury {100 * max(crash['injury_risk']):.2g} %"
    found, brackets = f"most likely of {failures.total:,} failures found", "in brackets the central 90 %"
    if details:
        yield f"{found} ({f}; {brackets} of ordinary scenarios):"
        yield from [f"  {what}"] if what else []
        yield from _list_parameters(space, failures.x[k])
        return
    yield f"{found}: {what or f}"
    unusual = _list_unusual(space, failures.x[k])
    but = " but drivers' weights or noise" if max(space.sizes) > MAX_SHOWN else ""
    nothing = f"nothing beyond the central 90 % of ordinary scenarios{but}"
    yield f"  unusual in it: {f'{unusual} ({brackets} of ordinary scenarios)' if unusual else nothing}"


def _list_unusual(space: ScenarioSpace, x: FloatArray) -> str:
    """Return the parameters of a scenario x (d,) that are outside the central 90 % of ordinary scenarios."""
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


def _list_parameters(space: ScenarioSpace, x: FloatArray) -> Iterator[str]:
    """Yield the parameters of a scenario x (d,), each beside the range that is ordinary; large blocks in summary."""
    ordinary = draw_ordinary(space)
    own, usual = space.columns(x[None]), space.columns(ordinary)
    for name, size, unit in zip(space.names, space.sizes, space.units, strict=True):
        if size <= MAX_SHOWN:
            (low,), (high,) = find_ordinary_range(usual[name].reshape(-1, 1))  # of all values of a block
            values = " ".join(f"{format_value(value):>8}" for value in own[name].flat)
            text = f"{values} {unit:<4} [{format_value(low, 1)} to {format_value(high, 1)}]"
        else:
            normal = space.columns(space.to_standard_normal(np.vstack((x, ordinary))))[name]
            distance = np.linalg.norm(normal, axis=1)
            low, high = np.quantile(distance[1:], (0.05, 0.95))
            spread = (own[name][0] - usual[name].mean(axis=0)) / np.maximum(usual[name].std(axis=0), 1e-12)
            furthest = int(np.abs(spread).argmax())
            text = f"{size:,} values, {distance[0]:.2f} standard deviations from their mean [{low:.1f} to {high:.1f}]"
            text += f", most in {name}[{furthest}], {spread[furthest]:+.1f}"
        yield _write_row(name, text)
