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
    """Return a rate with two digits.

    Example:
        >>> [format_rate(value) for value in (202.5, 5.14, 0.26, 0.0007, 0.0)]
        ['200', '5.1', '0.26', '7.0e-04', '0']
    """
    return format_alike(value)[0]


def format_alike(*values: float) -> list[str]:
    """Return rates with two digits, all as decimals or all with powers of ten.

    Example:
        >>> format_alike(0.011, 0.001, 0.12), format_alike(0.011, 1e-4, 0.12), format_alike(11.0, 0.16, 820.0)
        (['0.011', '0.0010', '0.12'], ['1.1e-02', '1.0e-04', '1.2e-01'], ['11', '0.16', '820'])
    """
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

    Example:
        >>> format_with_interval(0.011, (0.001, 0.12), " per hour")
        '0.011 per hour (0.0010 to 0.12)'
        >>> format_with_interval(2e-7, (0.0, 1700.0), level="95 %: ")
        '2.0e-07 (95 %: below 1.7e+03)'
    """
    middle, low, high = format_alike(value, *interval)
    return f"{middle}{unit} ({level}{f'{low} to' if interval[0] > 0 else 'below'} {high})"


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
    return "serious injuries (MAIS 3+) " + format_with_interval(
        rate.per_million_km, rate.interval_per_million_km, " per million km", f"{100 * rate.confidence:g} %: "
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
