"""Text of rates and of what their uncertainty comes from."""

from __future__ import annotations

import math

from rare_envs.exposure.rate import CollisionRate, RateInterval
from rare_envs.exposure.total_rate import FurtherEvents, TotalRate, VarianceShare

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
    """Return a rate with its interval, or what it is below, all numbers in one form.

    Args:
        value: The rate.
        interval: Its interval.
        unit: Behind the rate, with a space before it.
        level: Before the interval, with a space after it.
    """
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

    Args:
        total: The total.
        recorded: Events behind the base of each scenario, by its name.
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
