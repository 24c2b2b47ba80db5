"""Numbers of a report in plain words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rare_envs.exposure import describe_human_contacts
from rare_envs.measures import MEASURES
from rare_envs.study.crash_kinds import KIND_DESCRIPTIONS
from rare_envs.study.rates.text import format_with_interval

Result = Mapping[str, Any]
WIDE_BASE = 10.0
"""Ratio of the ends of the interval of the base distribution from which on the report warns of it."""
SIZED_BY_BUDGET = ("mc", "is", "two-stage", "surrogate")
"""Methods whose setting n is their budget where max_sim does not say; the n of others is that of a level."""


def format_probability(p: float | None, like: float | None = None) -> str:
    """Return a probability for people: as a percentage, or in powers of ten where it is small.

    Args:
        p: The probability.
        like: Another one that stands beside it and decides on the form; itself by default.
    """
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


def describe_validity(result: Result) -> str:
    """Return what the answer rests on, in the words of `samplers.Estimate.proviso`."""
    draws = int(result.get("base_draws") or 0)
    if draws == 0:
        return "valid if no failure region was missed (no draws of ordinary traffic limit its probability)"
    unseen, confidence = format_probability(result.get("unseen")), float(result["confidence"])
    if float(result["p"]) == 0 and not result.get("n_failures"):
        return (
            f"none of {draws:,} draws of ordinary traffic failed, so p is below {unseen} with {100 * confidence:g} % "
            f"confidence (the upper end of the interval has {50 + 50 * confidence:g} % or more)"
        )
    return (
        f"valid if no failure region was missed; {draws:,} draws of ordinary traffic would have met one with "
        f"probability above {unseen} ({100 * confidence:g} % confidence)"
    )


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
