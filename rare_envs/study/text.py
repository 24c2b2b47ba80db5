"""Text of an answer: the number, what it rests on, rates, crashes; on the terminal and in the report."""

from __future__ import annotations

import itertools
import math
import shlex
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text
from scipy.special import ndtri

import samplers
from rare_envs import exposure, people
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.egos.reference import REFERENCE_EGOS
from rare_envs.measures import MEASURES
from rare_envs.people import MODEL, NO_HEADWAY_RULE, EventRate, sum_people
from rare_envs.plugins import clean_text
from rare_envs.scenarios.cut_in import ATTENTION_LIMIT, CUTTER
from rare_envs.startup import __version__
from rare_envs.study.arguments import GATE_CODES, Question
from rare_envs.study.episodes import MAX_SHOWN, Column, draw_ordinary, find_ordinary_range, format_value, list_columns
from rare_envs.study.failures import KIND_DESCRIPTIONS
from rare_envs.study.replay import describe_contact
from rare_envs.study.report import MODEL_NOUN, Report, describe_left_out, explain_other_events
from samplers.comparison import UNLIMITED, list_ratio_facts
from samplers.output import MOST_LINES, WIDTH, Row, fold_rows, format_alike, indent_lines, say
from samplers.problem import FloatArray
from samplers.result import list_facts, list_warnings

EVENT_NOUNS = {
    "cut_in": "cut-ins",
    "stop": "stops of the lead",
    "slowing": "slowings of the lead",
    "hard_brake": "brakings",
    "car_following": "new leaders",
}
"""Events, and those of scenarios, in the plural."""
OUTCOME_NOUNS = {
    "near_crashes": "+ near-crashes",
    "serious_injuries": "MAIS 3+ injuries",
    **{f"delta_v_above_{v}": f"delta-v > {v} m/s" for v in (2, 5, 10)},
}
"""Names of what is compared beside crashes; near-crashes come on top of these."""
OTHER_NOUNS = {MODEL: "human driver model", "cc_human": "competent and careful driver", "idm": "IDM"}
"""Drivers that are put in the ego's place."""
SOURCE_NOUNS = {"counts": "event counts", "sampling": "simulations"}


def format_rate(value: float) -> str:
    """Return a rate with two digits."""
    return format_alike(value)[0]


def format_with_interval(value: float, interval: exposure.RateInterval, unit: str = "", level: str = "") -> str:
    """Return a rate with its interval, all numbers in one form, or with what it is below."""
    if interval[0] <= 0:  # with an upper end alone the value may be smaller by any power
        return f"{format_rate(value)}{unit} ({level}below {format_rate(interval[1])})"
    middle, low, high = format_alike(value, *interval)
    return f"{middle}{unit} ({level}{low} to {high})"


def format_ratio(ratio: float | None, interval: Sequence[float | None]) -> str:
    """Return a ratio with its interval, or its one limit; None is what is not finite."""
    low, high = interval[0] or 0.0, math.inf if interval[1] is None else interval[1]
    if low <= 0 or math.isinf(high):
        one = f"below {format_rate(high)}" if low <= 0 else f"above {format_rate(low)}"
        return "not known" if low <= 0 and math.isinf(high) else one
    if high > UNLIMITED * low:
        return f"{format_rate(ratio or 0.0)} (no limits)"
    return format_with_interval(ratio or 0.0, (low, high))


def format_share(share: float) -> str:
    """Return a share in per cent: whole, or one digit below 1 %; 100 % is all of it."""
    if 0.995 <= share < 1 - 1e-9:
        return "over 99 %"
    return f"{100 * share:.0f} %" if share >= 0.01 else f"{100 * share:.1g} %"


def format_shares(shares: Sequence[float]) -> list[str]:
    """Return shares of one whole in per cent that add to no more than 100: the largest is at most what remains."""
    texts = [format_share(share) for share in shares]
    largest = int(np.argmax(shares)) if texts else 0
    others = sum(float(each.removesuffix(" %")) for k, each in enumerate(texts) if k != largest)
    if others >= 1:
        texts[largest] = f"{min(round(100 * shares[largest]), math.floor(100 - others))} %"
    return texts


def name_scenario(name: str) -> str:
    """Return the name of a scenario in words: "hard brake"."""
    return "cut-in" if name == "cut_in" else name.replace("_", " ")


def name_event(each: EventRate) -> str:
    """Return a kind of event in the plural."""
    return EVENT_NOUNS.get(each.event, each.event)


def format_events(rate: exposure.CollisionRate | exposure.TotalRate, unit: str = "", level: str = "") -> str:
    """Return a rate of collisions with its interval; a limit that is no less than the rate of the events is none."""
    if rate.limited:
        return format_with_interval(rate.per_million_km, rate.interval_per_million_km, unit, level)
    return f"{format_rate(rate.per_million_km)}{unit} ({level}no lower or upper limit)"


def describe_injuries(rate: exposure.CollisionRate | exposure.TotalRate) -> str:
    """Return a rate of serious injuries with its interval."""
    return say("serious injuries", rate=format_events(rate, " per million km"))


def describe_people(counted: people.HumanBenchmark | None, confidence: float) -> str:
    """Return people's contacts per million km with their interval."""
    if counted is None:
        return "not counted"
    return format_with_interval(counted.per_million_km, counted.interval_at(confidence))


def describe_rate(each: EventRate) -> str:
    """Return the rate of an event per million km with its interval, or its upper limit if too few failed."""
    if each.event in each.unresolved and each.rate.limited:
        return f"below {format_rate(each.rate.interval_per_million_km[1])}"
    return format_events(each.rate)


def describe_model(each: EventRate) -> str:
    """Return the contacts per million km of the human driver model, with and without headway rule; "-" if unknown."""
    if each.calibration is None:
        return "-"
    counts = [each.calibration.per_million_km(name) for name in (MODEL, NO_HEADWAY_RULE)]
    if not any(count.p for count in counts):
        return f"below {format_rate(max(count.high for count in counts))}"
    return " and ".join(dict.fromkeys(format_alike(*(count.p for count in counts))))


def describe_calibration(each: EventRate) -> str:
    """Return whether the human driver model comes near people in an event."""
    known, model = each.calibration, describe_model(each)
    if known is None:
        return say("not measured", traffic=Path(each.traffic).name)
    if not known.is_calibrated:
        return say("not calibrated", model=model, far=known.describe_factor())
    return say("calibrated", model=model, factor=f"{people.CALIBRATED_WITHIN:g}")


def describe_calibrations(events: Sequence[EventRate]) -> str:
    """Return in which events the human driver model comes near people, and why it does not in the others."""
    near = ", ".join(name_event(each).removesuffix(" of the lead") for each in events if not each.uncalibrated)
    known = [say("calibrated in", nouns=near, factor=f"{people.CALIBRATED_WITHIN:g}")] if near else []
    far = (f"{name_event(each)} {describe_calibration(each)}" for each in events if each.uncalibrated)
    return "; ".join([*known, *far])


def describe_parts(shares: Mapping[str, float], unresolved: Mapping[str, float]) -> str:
    """Return the shares of strata in a rate, the largest first, and the upper limits of those with too few failures.

    "of which unseen 92 %, looked 8 %", or "of which unseen 100 %; stratum looked: too few failures found, below 2.6".
    """
    ordered = sorted(shares.items(), key=lambda part: -part[1])
    texts = format_shares([share for _, share in ordered])
    known = ", ".join(
        f"{name} {text}" for (name, _), text in zip(ordered, texts, strict=True) if name not in unresolved
    )
    vague = (say("too few failures", name=name, high=format_rate(high)) for name, high in unresolved.items())
    return "".join([*([f"of which {known}"] if known else []), *vague]).removeprefix("; ")


def tabulate(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of words as lines with columns as wide as their longest word."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{word:<{width}}" for word, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def tabulate_events(events: Sequence[EventRate], total: exposure.TotalRate | None = None) -> list[str]:
    """Return a table of the rates of events per million km, each beside people and the human driver model in it.

    With `total` its last row has the sum, beside people in all of these events.
    """
    rows = [("", "per km", "per event", "per million km", "people in them", "human model")]
    for each in events:
        rate, resolved = each.rate, each.event not in each.unresolved
        found = rate.p if rate.interval is None or (rate.p > 0 and resolved) else rate.interval[1]
        p = f"{'' if rate.p > 0 and resolved else 'below '}{min(found / each.share, 1.0):.1e}"
        numbers = format_rate(rate.frequency.per_km * each.share), p
        name = name_event(each).removesuffix(" of the lead")  # a row of less than a hundred columns
        rows.append(
            (name, *numbers, describe_rate(each), describe_people(each.people, rate.confidence), describe_model(each))
        )
    if total is not None:
        whole = format_events(total)
        rows.append(("all", "", "", whole, describe_people(sum_people(events), total.confidence), ""))
    head, *lines = tabulate(rows)
    vague = ({name: end for name, end in each.unresolved.items() if name != each.event} for each in events)
    below = (describe_parts(each.parts, ends) for each, ends in zip(events, vague, strict=True))
    parts = ([f"  {more}"] if more else [] for more in below)
    table = (line for row, more in zip(lines, parts, strict=False) for line in (row, *more))
    return [head, *table, *lines[len(events) :]]


COLUMNS = (
    f"{MODEL} and {NO_HEADWAY_RULE} in the same events; a rate is calibrated within a factor of "
    f"{people.CALIBRATED_WITHIN:g} of people's interval (people: 100-Car, contacts at any speed)"
)
"""What the columns of people and of the human driver model are."""


def describe_uncertainty(total: exposure.TotalRate) -> str:
    """Return what the uncertainty of a total comes from, first what has no lower limit; empty if it is not known."""
    parts = []
    for rate in (each for each in total.rates if not each.determined):
        fact = "no lower limit" if rate.p > 0 else "no failure in a scenario"
        high = format_rate(rate.interval_per_million_km[1])
        parts.append(say(fact, name=name_scenario(rate.scenario), high=high))
    if total.shares:
        sources = []
        for text, each in zip(format_shares([each.share for each in total.shares]), total.shares, strict=True):
            scenario = name_scenario(each.scenario)
            nouns = {"base": f"{scenario} {MODEL_NOUN}", "site": f"{scenario} at other sites", **SOURCE_NOUNS}
            sources.append(f"{text} {nouns[each.source]}")
        parts.append(f"{'the rest: ' if parts else ''}{', '.join(sources)}")
    return "; ".join(parts)


Result = Mapping[str, Any]
"""What result.json holds."""


def explain_reference(result: Result) -> list[str]:
    """Return a sentence for each reference driver that crashes more often than people in the events of a run.

    That is known from the ego's failures alone: its rate times the share in which the other crashes too.
    """
    events, ego = result.get("events") or [], result["question"]["ego"]
    if not events or any(each["people"] is None for each in events):
        return []
    rate, counted = (sum(each["per_million_km"] for each in found) for found in (events, [e["people"] for e in events]))
    most = sum(each["people"]["interval_per_million_km"][1] for each in events)
    nouns = " and ".join(EVENT_NOUNS.get(each["event"], each["event"]) for each in events)
    fails = {name: each["fails"] for name, each in (result.get("other_drivers") or {}).items()} | {ego: 1.0}
    return [
        f"{name} crashes at least {format_rate(rate * share / counted)} times as often as people in {nouns}: what it "
        "avoids of them says little of careful people."
        for name, share in fails.items()
        if name in REFERENCE_EGOS and rate * share > most
    ]


def is_better_known(found: Result) -> bool:
    """Return whether the ratio of a comparison has narrower intervals than the probability of either ego."""
    base, of_either = found["base_uncertainty"], found["either"]["base_uncertainty"]
    pairs = [(found["interval"], found[side]["interval"]) for side in ("a", "b")]
    pairs += [(base["interval"], of_either["interval"])] if base and of_either else []
    return all(_log_width(ratio) < _log_width(p) for ratio, p in pairs)


def _log_width(ends: Sequence[float | None] | None) -> float:
    """Return the width of an interval of a logarithm; infinite if an end is not known."""
    low, high = ends or (None, None)
    return math.log(high / low) if low and high else math.inf


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
        return "not known, as no failure counts in p"
    if not resolved:
        return "not known, as too few failures were found in a stratum"
    return "none, as every scenario fails" if p >= 1 else "not known, as the relative error is 1 or more"


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


PLAIN_NAMES = {
    "ego_speed": "ego at",
    "speed": "both at",
    "lead_speed": "lead at",
    "cut_in_speed": "cutter at",
    "duration": "lane change in",
    "peak": "lead brakes at",
    "loss": "lead loses",
}
"""Words before the value of a parameter, in place of its name."""
IN_WORDS = {
    "cut_in_gap": (0.0, "the cutter starts beside the ego"),
    "attention": (ATTENTION_LIMIT, "the cutter does not look"),
    "indicator": (float(ndtri(1 - CUTTER.indicating)), "the cutter does not signal"),
    **dict.fromkeys(("noticing", "lead_braking", "lead_peak", "lead_loss"), (-math.inf, "")),
}
"""Parameters of a cut-in: the value below which words say more than it, and the words; standard normal ones have none
above."""
N_UNUSUAL = 3
"""Parameters of the most likely failure that are named at most."""
NAMED_SHARE = 1e-4
"""Share of p from which on a kind of crash is named."""
WHOLE = 1_000
"""Lines of an answer that is not cut."""
CRASHES = "Crashes"
"""The name of p if it counts collisions of the ego."""


ENOUGH, MANY = 30, 1_000_000
"""Failures that a run by plain Monte Carlo is to find, and simulations that are advised for it at most."""


def describe_answer(report: Report, last: Sequence[Row] = (), most: int = MOST_LINES) -> list[str]:
    """Return the answer in at most so many lines: the number with its widest interval first; `last` are further facts.

    Method, c.o.v. and all intervals are in `list_details`.
    """
    study, estimate = report.study, report.estimate
    average = f", {report.average}" if report.average else f", traffic {Path(study.base_name).name}"
    title = f"{study.question.ego} in {study.question.env_id}{average}"
    noun = EVENT_NOUNS.get(study.problem.world.scenario.name, "scenarios")
    left_out = describe_left_out(study, estimate)
    name = name_p(study.question)
    what = "Crash" if name == CRASHES else "Failure"
    *facts, missed = list_facts(estimate, name, noun, MODEL_NOUN, left_out)
    rows = [*facts, *_list_rates(report), (what, _describe_crashes(report)), missed]
    head = textwrap.wrap(title, WIDTH, subsequent_indent="  ")
    return [*head, *fold_rows([*rows, *list_warnings(report.warnings), *last], most - len(head))]


def describe_comparison(
    found: samplers.comparison.Comparison, question: Question, ego_b: str, kinds: Mapping[str, tuple[float, float]]
) -> list[str]:
    """Return the comparison of a question's ego with another one in at most `MOST_LINES` - 1 lines.

    `kinds` are as in `list_avoided`.
    """
    a, b = shorten_egos(question.ego, ego_b)
    fails = "crashes" if name_p(question) == CRASHES else "fails"
    rows = [*list_ratio_facts(found, a, b, fails, MODEL_NOUN), *list_avoided(kinds, a, b)]
    return [
        f"{a} (A) against {b} (B) in {question.env_id}",
        *fold_rows([*rows, *list_warnings(found.all_warnings)], MOST_LINES - 2),
    ]


def shorten_egos(*egos: str) -> list[str]:
    """Return the names of egos, of files without their folders."""
    return [Path(ego).name if Path(ego).suffix else ego for ego in egos]


def list_avoided(kinds: Mapping[str, tuple[float, float]], a: str, b: str) -> list[Row]:
    """Return which of A's crashes B avoids: of how often A has a kind of crash, and how often B then has none."""
    whole = sum(each for each, _ in kinds.values())
    if not whole > 0:
        return []
    share = format_share(sum(avoided for _, avoided in kinds.values()) / whole)
    named = {kind: each for kind, each in kinds.items() if each[0] > NAMED_SHARE * whole}
    parts = [f"{format_share(less / own)} of {describe_kind(kind)}" for kind, (own, less) in named.items()]
    if len(named) > 1:
        texts = format_shares([own / whole for own, _ in named.values()])
        parts = [f"{part} ({text})" for part, text in zip(parts, texts, strict=True)]
    return [("Avoided", say("avoided", a=a, b=b, share=share, kinds=", ".join(parts)))]


def report_as_json(report: Report, top: int = 10) -> dict[str, Any]:
    """Return JSON-ready values: question, estimate, the `top` most likely failures, the whole answer as `text`."""
    failures, kinds, space = report.estimate.failures, report.kinds, report.study.problem.space
    listed = itertools.islice(zip(failures, report.crashes, strict=True), top)

    def convert(value: Any) -> Any:
        return None if value is None else value.to_dict()

    def name_values(x: FloatArray) -> dict[str, Any]:
        return {name: np.asarray(value).tolist() for name, value in space.named(x).items()}

    def name_others(*kind: str) -> dict[str, Any]:
        return {name: each._asdict() for name, each in kinds.find_others(*kind).items()}

    return {
        **report.estimate.to_dict(),
        "question": asdict(report.study.question),
        "average": report.average,
        "proviso": report.estimate.proviso,
        "gate": convert(report.verdict),
        "doubtful": report.doubtful,
        "doubts": report.warnings,
        "notes": report.notes,
        "vec_normalize": report.vec_normalize,
        "doubt_of_statistics": report.doubt_of_statistics,
        "seconds": report.seconds,
        "earlier_seconds": report.earlier_seconds,
        "n_failures": failures.total,
        "kinds": {
            kind: {**share.to_dict(), "other_drivers": name_others(kind)} for kind, share in kinds.shares.items()
        },
        "other_drivers": name_others(),
        "n_other_drivers": kinds.n_others,
        "modes": [mode.to_dict() for mode in kinds.modes],
        "curve": convert(report.curve),
        "severity": convert(kinds.severity),
        "sensitivity": None if isinstance(report.sensitivity, str) else convert(report.sensitivity),
        "failures": [
            {"parameters": name_values(one.x), "f": one.f if math.isfinite(one.f) else None}
            | {"log_p0": one.log_p0, "crash": crash}
            for one, crash in listed
        ],
        "n_faults": len(report.faults),
        "n_retried": report.n_retried,
        "repeatability": convert(report.repeatability),
        "faults": [{"parameters": name_values(one.x), "reason": one.reason} for one in report.faults[:top]],
        "units": dict(zip(space.names, space.units, strict=True)),
        "rate": convert(report.rate),
        "events": [each.to_dict() for each in report.events],
        "injury_rate": convert(report.injury_rate),
        "no_rate": report.no_rate,
        "other_bases": [
            {"base": name, **({"refused": found} if isinstance(found, str) else {"refused": "", **found.to_dict()})}
            for name, found in report.other_bases.items()
        ],
        "version": __version__,
        "text": [*describe_answer(report, most=WHOLE), *list_gate(report.verdict)],
    }


def name_p(question: Question) -> str:
    """Return what a question counts."""
    if not explain_other_events(question):
        return CRASHES
    return f"P[{'f' if ':' in question.measure else question.measure} <= {question.gamma:g}]"


def print_report(report: Report, out: Path | None = None, details: bool = False) -> None:
    """Print the answer, with details everything behind it, and last the verdict, if there is a limit."""
    console = CleanConsole(highlight=False, soft_wrap=True, markup=False)
    where = "--details" if out is None else f"rare-envs report {shlex.quote(str(out))}".replace(" ", "\xa0")
    what = say("details" if out is None else "report")
    gate = list_gate(report.verdict)
    title, *lines = describe_answer(report, [("Next", say("next", command=where, what=what))], MOST_LINES - len(gate))
    console.print(title, style="bold")
    for line in lines:
        console.print(line, style="yellow" if line.startswith("Warning") else None)
    asked = [_write_row(*row) for row in _list_other_bases(report)]
    asked += indent_lines(report.sensitivity) if isinstance(report.sensitivity, samplers.analysis.Sensitivity) else []
    for line in (*asked, *(list_details(report, out) if details else ())):
        console.print(line)
    for line in gate:
        console.print(line, style="bold")


def list_gate(verdict: samplers.analysis.Verdict | None) -> list[str]:
    """Return the lines of a verdict, the last of them with the decision, its exit code and its cause."""
    if verdict is None:
        return []
    ends, why = verdict.describe_ends(), verdict.cause
    if why and verdict.if_exact in ("passes", "fails"):
        why += f"; --assume-traffic {verdict.if_exact}"
    line = say("gate", decision=verdict.decision, code=GATE_CODES[verdict.decision], why=why or ends)
    return [*(fold_rows([("Limit", ends)]) if why else []), textwrap.shorten(line, WIDTH, placeholder=" ...")]


def list_details(report: Report, out: Path | None = None) -> Iterator[str]:
    """Yield all intervals, the method and its effort, all parameters of the most likely failure, and all remarks."""
    estimate, question = report.estimate, report.study.question
    warned = replace(estimate, warnings=report.doubts_of_method, remarks=report.remarks)
    yield from ("", *warned.details().replace("base distribution", MODEL_NOUN).splitlines())
    earlier = f" ({report.earlier_seconds:.0f} s before it was resumed)" if report.earlier_seconds else ""
    made_by = f"{question.core}{'' if question.device == 'cpu' else f' on {question.device}'}"
    yield f"  {report.seconds:.1f} s{earlier} by {made_by}"
    yield from (_write_row(*row) for row in (*_list_all_rates(report), *_list_kinds(report), *_list_faults(report)))
    yield from (f"  {line}" for line in _describe_failure(report))
    yield from (f"warning: {warning}" for warning in report.doubts_of_f)
    yield from (f"note: {note}" for note in report.notes)
    if question.method != "mc" and ENOUGH / MANY <= estimate.p < estimate.unseen:
        place = 10 ** math.floor(math.log10(ENOUGH / estimate.p))
        n = place * math.ceil(ENOUGH / estimate.p / place)
        yield f"check: --method mc --max-sim {n} is plain Monte Carlo, without a search"
    if out is not None:
        names = ", ".join(path.name for path in sorted(out.iterdir()) if path.is_file())
        yield f"written to {out}: {names}"


def _list_rates(report: Report) -> Iterator[Row]:
    """Yield collisions per million km beside people and the human driver model in the same events, or why not."""
    rate, events = report.rate, report.events
    if rate is None:
        yield "Rate", report.no_rate
        return
    found = format_events(rate, " per million km")
    injuries, counted = report.injury_rate, describe_people(sum_people(events), rate.confidence)
    nouns = [name_event(each) for each in events]
    if len(events) == 1:
        yield "Rate", say("rate", rate=found, noun=nouns[0], people=counted)
        yield "Calibration", describe_calibration(events[0])
        if injuries is not None:
            yield "Injuries", describe_injuries(injuries)
        return
    yield "Rate", say("rate of all", rate=found, people=counted)
    for noun, each in zip(nouns, events, strict=True):
        model = f"{describe_model(each)}{', not calibrated' if each.uncalibrated else ''}"
        counted = describe_people(each.people, rate.confidence)
        yield "of which", say("rate of one", noun=noun, rate=describe_rate(each), people=counted, model=model)


def _describe_crashes(report: Report) -> str:
    """Return the kinds of crash by their share in p, and the most likely crash in a sentence."""
    failures, space, shares = report.estimate.failures, report.study.problem.space, report.kinds.shares
    if not len(failures):
        return "no failure found"
    named = {kind: each.of_failures for kind, each in shares.items() if each.of_failures >= NAMED_SHARE}
    kinds = describe_kinds(named)
    k = _find_likeliest(failures)
    what, unusual = _describe_end(report, k), _list_unusual(space, failures.x[k])
    text = f"{what}, {unusual or say('usual')}"
    other = report.kinds.find_others().get(MODEL)
    if other is not None and other.n >= ENOUGH and report.study.question.ego != MODEL:
        kinds += f"; {say('avoids', driver=OTHER_NOUNS[MODEL], share=format_share(1 - other.fails))}"
    return say("likeliest", kinds=kinds, what=text) if kinds else text


def describe_kinds(shares: Mapping[str, float]) -> str:
    """Return kinds of crash with their shares."""
    texts = format_shares([*shares.values()])
    return ", ".join(f"{text} {describe_kind(kind)}" for text, kind in zip(texts, shares, strict=True))


def _find_likeliest(failures: samplers.Failures) -> int:
    """Return the number of the most likely failure, of those with an outcome if there are any."""
    return int(np.argmax(~np.isnan(failures.f)))


def _describe_end(report: Report, k: int) -> str:
    """Return how a failure ends: its crash, or its f."""
    crash, f = report.crashes[k], report.estimate.failures.f[k]
    if crash is None:
        return "the ego gave no answer" if math.isnan(f) else f"f = {f:.3g}"
    contact = describe_contact(crash, report.study.problem.world.scenario.labels)
    speed, delta_v = (f"{value:.1f}" for value in (crash["impact_speed"], max(crash["delta_v"])))
    return say("crash", contact=contact, speed=speed, delta_v=delta_v)


def _write_row(name: str, text: str) -> str:
    return f"  {name:<15} {text}"


def _list_other_bases(report: Report) -> Iterator[Row]:
    """Yield p under the other bases that the question names, or why the simulations do not give it."""
    for base, found in report.other_bases.items():
        if isinstance(found, str):
            yield f"with {base}", f"not known: {found}"
            yield "", f"simulate with --base {base}, or raise --max-sim for more failing points"
        else:
            p, low, high = format_alike(found.p, *found.interval)
            yield f"with {base}", f"{p} ({low} to {high}), {found.ess:.0f} effective failing points"


def _list_all_rates(report: Report) -> Iterator[Row]:
    """Yield what the rate is made of, by event and source of uncertainty, and injuries."""
    rate, injuries = report.rate, report.injury_rate
    if rate is None:
        return
    yield "collisions", format_events(rate, " per million km")
    yield from (("", line) for line in tabulate_events(report.events))
    events = f"{format_rate(rate.frequency.per_km)} {EVENT_NOUNS.get(rate.scenario, 'events')} per km"
    yield "", "; ".join(filter(None, [f"from {events}", describe_uncertainty(exposure.TotalRate((rate,)))]))
    if injuries is not None:
        yield "injuries", describe_injuries(injuries)


def _list_kinds(report: Report) -> Iterator[Row]:
    """Yield p by kind of crash, and how severe the collisions are."""
    rows = []
    for kind, share in report.kinds.shares.items():
        low, high = share.interval
        numbers = f"{share.p:.1e} [{low:.1e}, {high:.1e}], {100 * share.of_failures:.3g} %"
        rows.append(f"{numbers}: {describe_kind(kind)}")
    for name, lines in {"of which": rows, "severity": str(report.kinds.severity or "").splitlines()}.items():
        yield from ((name if number == 0 else "", line) for number, line in enumerate(lines))


def _list_faults(report: Report) -> Iterator[Row]:
    """Yield the statistics that normalise observations, and the scenarios on which the ego failed."""
    if report.vec_normalize is not None:
        yield "observations", f"normalised by {report.vec_normalize}"
    if report.faults:
        first = report.faults[0].reason
        yield "faults", f"the ego gave no answer in {len(report.faults)} scenarios (asked twice); the first: {first}"
        yield "", f"{report.n_retried:,} more simulations were made to find them"


def _describe_failure(report: Report) -> Iterator[str]:
    """Yield the most likely failure: how it ends, and all of its parameters."""
    failures = report.estimate.failures
    if not len(failures):
        return
    k = _find_likeliest(failures)
    f = "the ego gave no answer" if math.isnan(failures.f[k]) else f"f = {failures.f[k]:.3g}"
    yield f"most likely of {failures.total:,} failures found ({f}; in parentheses: central 90 % of ordinary scenarios):"
    crash = report.crashes[k]
    if crash is not None:
        yield f"  {_describe_end(report, k)}, serious injury {100 * max(crash['injury_risk']):.2g} %"
    yield from _list_parameters(report.study.problem.space, failures.x[k])


def _list_unusual(space: ScenarioSpace, x: FloatArray) -> str:
    """Return the parameters of a scenario x (d,) that are outside the central 90 % of ordinary scenarios."""
    columns = list_columns(space)
    low, high = find_ordinary_range(draw_ordinary(space))
    beyond = np.maximum(low - x, x - high) / np.maximum(high - low, 1e-12)
    shown = [j for j in np.argsort(-beyond) if beyond[j] > 0 and columns[j].shown]
    texts = (_describe_unusual(columns[j], x[j], low[j], high[j]) for j in shown)
    return ", ".join([text for text in texts if text][:N_UNUSUAL])


def _describe_unusual(column: Column, value: float, low: float, high: float) -> str:
    """Return a parameter beside what is usual; a decision of a driver in words, or "" if it says nothing."""
    limit, words = IN_WORDS.get(column.name, (-math.inf, ""))
    if value < limit or (column.name in IN_WORDS and not column.unit):
        return words if value < limit else ""
    name = PLAIN_NAMES.get(column.name, column.name.replace("_", " "))
    known = {"value": value, "low": low, "high": high}
    numbers = {key: f"{'-' if each < 0 else ''}{format_rate(abs(each))}" for key, each in known.items()}
    return say("unusual", name=name, unit=column.unit, **numbers)


def _list_parameters(space: ScenarioSpace, x: FloatArray) -> Iterator[str]:
    """Yield the parameters of a scenario x (d,), each beside the range that is ordinary; large blocks in summary."""
    ordinary = draw_ordinary(space)
    own, usual = space.columns(x[None]), space.columns(ordinary)
    for name, size, unit in zip(space.names, space.sizes, space.units, strict=True):
        if size <= MAX_SHOWN:
            (low,), (high,) = find_ordinary_range(usual[name].reshape(-1, 1))  # of all values of a block
            values = " ".join(f"{format_value(value):>8}" for value in own[name].flat)
            text = f"{values} {unit:<4} ({format_value(low, 1)} to {format_value(high, 1)})"
        else:
            normal = space.columns(space.to_standard_normal(np.vstack((x, ordinary))))[name]
            distance = np.linalg.norm(normal, axis=1)
            low, high = np.quantile(distance[1:], (0.05, 0.95))
            spread = (own[name][0] - usual[name].mean(axis=0)) / np.maximum(usual[name].std(axis=0), 1e-12)
            furthest = int(np.abs(spread).argmax())
            text = f"{size:,} values, {distance[0]:.2f} standard deviations from their mean ({low:.1f} to {high:.1f})"
            text += f", most in {name}[{furthest}], {spread[furthest]:+.1f}"
        yield _write_row(name, text)
