"""Text of rates and of what their uncertainty comes from."""

from __future__ import annotations

import math

from rare_envs.exposure.rate import CollisionRate, RateInterval
from rare_envs.exposure.total_rate import FurtherEvents, TotalRate, VarianceShare

EVENT_NOUNS = {"cut_in": "cut-ins", "hard_brake": "brakings", "car_following": "new leaders"}
"""Events of the scenarios, in the plural."""
SOURCE_NOUNS = {"counts": "event counts", "sampling": "simulation"}
PART_NOUNS = {"base": "base distribution", "site": "difference between sites", **SOURCE_NOUNS}
LARGE, SMALL = 99.5, 0.01
"""Rates from which whole numbers, and below which powers of ten are shown."""


def format_rate(value: float) -> str:
    """Return a rate with two digits.

    Example:
        >>> [format_rate(value) for value in (202.5, 5.14, 0.26, 0.0007, 0.0)]
        ['200', '5.1', '0.26', '7.0e-04', '0']
    """
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if value >= LARGE:
        return f"{round(value, 1 - math.floor(math.log10(value))):,.0f}"
    return f"{value:#.2g}".rstrip(".") if value >= SMALL else f"{value:.1e}"


def format_interval(interval: RateInterval) -> str:
    """Return an interval of a rate, or what it is below.

    Example:
        >>> format_interval((0.4, 62.0)), format_interval((0.0, 3.0))
        ('0.40 to 62', 'below 3.0')
    """
    low, high = interval
    return f"{format_rate(low)} to {format_rate(high)}" if low > 0 else f"below {format_rate(high)}"


def format_share(share: float) -> str:
    """Return a share in per cent: whole, or one digit below 1 %.

    Example:
        >>> format_share(0.844), format_share(0.0012)
        ('84 %', '0.1 %')
    """
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
    return (
        f"serious injuries (MAIS 3+) {format_rate(rate.per_million_km)} per million km "
        f"({100 * rate.confidence:g} %: {format_interval(rate.interval_per_million_km)})"
    )


def describe_sources(shares: tuple[VarianceShare, ...]) -> str:
    """Return the sources of the uncertainty of a total, the largest first.

    Example:
        >>> describe_sources((VarianceShare("base", "cut_in", 0.84), VarianceShare("counts", "", 0.16)))
        '84 % the cut-in distribution, 16 % event counts'
    """
    return ", ".join(f"{format_share(each.share)} {name_source(each)}" for each in shares)


def describe_further_events(needed: FurtherEvents) -> str:
    """Return how many further events would halve the uncertainty, in words.

    Example:
        >>> describe_further_events(FurtherEvents("cut_in", 312, 114))
        'about 310 further recorded cut-ins would halve it'
    """
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
