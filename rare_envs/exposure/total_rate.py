"""Collisions over several scenarios: the sum of their rates, and what its uncertainty comes from.

The rates are added, with their variances, not their logarithms. As they are wide and skewed, the interval is that of
the sum of draws from each. Scenarios whose bases were fitted to the same events share that error. A scenario whose p
is not determined (nothing failed, or its events do not determine p) raises the upper end alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from rare_envs.arrays import FloatArray
from rare_envs.exposure.rate import MILLION_KM, RATE_DRAWS, CollisionRate, RateInterval, tail_levels


class VarianceShare(NamedTuple):
    """One source of the uncertainty of a total.

    Example:
        >>> VarianceShare("base", "cut_in", 0.84).scenario
        'cut_in'
    """

    source: str
    """"base", "site" (of one scenario), "counts" or "sampling" (of all)."""
    scenario: str
    """The scenario; empty for those of all."""
    share: float
    """Of the variance of the logarithm of the sum of the determined rates."""


class FurtherEvents(NamedTuple):
    """How many more recorded events would halve the width of the total's interval, in logarithms.

    Example:
        >>> FurtherEvents("cut_in", number=None, own=114).own
        114
    """

    scenario: str
    """The scenario whose base distribution contributes most."""
    number: int | None
    """Further events; None where those of this scenario alone cannot halve it."""
    own: int
    """Further events that halve the spread of its own base distribution: three times those recorded."""


@dataclass(frozen=True)
class TotalRate:
    """Collisions per hour and per million km over scenarios that count nothing twice.

    Example:
        >>> from rare_envs.distributions import EventFrequency
        >>> from rare_envs.exposure import CollisionProbability
        >>> brakings = EventFrequency(count=42, hours=5.64, km=218.0, definition="brakings", source="US 101")
        >>> p = CollisionProbability(p=1.8e-5, cov=0.02, upper=2e-5, spread=1.1)
        >>> total = TotalRate((CollisionRate(scenario="hard_brake", probability=p, frequency=brakings),))
        >>> low, high = total.interval_per_million_km
        >>> print(f"{total.per_million_km:.1f} ({low:.2f} to {high:.0f}), {total.shares[0].share:.0%} from the base")
        3.5 (0.39 to 31), 98% from the base
    """

    rates: tuple[CollisionRate, ...]

    def __post_init__(self) -> None:
        if not self.rates or len({rate.confidence for rate in self.rates}) > 1:
            raise ValueError("Expected rates of one confidence, one or more.")

    @property
    def confidence(self) -> float:
        """Nominal coverage of the intervals."""
        return self.rates[0].confidence

    @property
    def per_hour(self) -> float:
        """Collisions per hour of driving."""
        return sum(rate.per_hour for rate in self.rates)

    @property
    def per_million_km(self) -> float:
        """Collisions per million kilometres."""
        return sum(rate.per_million_km for rate in self.rates)

    @cached_property
    def interval_per_hour(self) -> RateInterval:
        """Interval of `per_hour`."""
        if len(self.rates) == 1:
            return self.rates[0].interval_per_hour
        return self._interval([rate.frequency.hours for rate in self.rates], [r.interval_per_hour for r in self.rates])

    @cached_property
    def interval_per_million_km(self) -> RateInterval:
        """Interval of `per_million_km`."""
        if len(self.rates) == 1:
            return self.rates[0].interval_per_million_km
        exposures = [rate.frequency.km / MILLION_KM for rate in self.rates]
        return self._interval(exposures, [rate.interval_per_million_km for rate in self.rates])

    @property
    def determined(self) -> tuple[CollisionRate, ...]:
        """The rates with an interval on both sides."""
        return tuple(rate for rate in self.rates if rate.determined)

    @cached_property
    def shares(self) -> tuple[VarianceShare, ...]:
        """Sources of the variance of the logarithm of the sum of the determined rates, per km, the largest first.

        Empty if none is determined. To first order the variance of this sum is the sum of R_i R_j c_ij over scenarios,
        c_ij the covariance of the logarithms: the variance of log R_i where i = j, sqrt(b_i b_j) of the bases where
        both were fitted to the same events, else 0.
        """
        parts = self._variance_parts()
        total = sum(parts.values())
        found = [VarianceShare(source, name, float(part / total)) for (source, name), part in parts.items() if part > 0]
        return tuple(sorted(found, key=lambda each: -each.share))

    def further_events(self, recorded: dict[str, int]) -> FurtherEvents | None:
        """Return the number of further events of one scenario that would halve the width of the interval.

        The spread of p over refits falls with 1 / sqrt(number of events). With m events behind a share b of the
        variance, m' events leave 1 - b (1 - m / m') of it, which is a quarter at m' = m b / (b - 3/4).

        Args:
            recorded: Events that each scenario's base was fitted to, by its name; those not known are left out.

        Returns:
            The numbers for the scenario with the largest share; None where none has any, or where a rate that is not
            determined adds its bound to the upper end, which further events of another scenario leave as it is.
        """
        if len(self.determined) < len(self.rates):
            return None
        first = next((each for each in self.shares if each.source == "base" and recorded.get(each.scenario)), None)
        if first is None:
            return None
        events, left_over = recorded[first.scenario], first.share - 0.75
        number = math.ceil(events * first.share / left_over - events) if left_over > 0 else None
        return FurtherEvents(first.scenario, number, 3 * events)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "per_hour": self.per_hour,
            "interval_per_hour": list(self.interval_per_hour),
            "per_million_km": self.per_million_km,
            "interval_per_million_km": list(self.interval_per_million_km),
            "confidence": self.confidence,
            "shares_of_variance": [each._asdict() for each in self.shares],
        }

    def _interval(self, exposures: list[float], single: list[RateInterval]) -> RateInterval:
        """Return the interval of the sum of the determined rates, and above it the upper ends of the others."""
        rng = np.random.default_rng(0)
        groups: dict[str, FloatArray] = {}
        drawn = np.zeros(RATE_DRAWS)
        above = 0.0
        for number, (rate, exposure, (_, high)) in enumerate(zip(self.rates, exposures, single, strict=True)):
            if not rate.determined:
                above += high
                continue
            key = rate.fitted_to or f"scenario {number}"
            groups.setdefault(key, rng.standard_normal(RATE_DRAWS))
            drawn += rate.draw(exposure, groups[key], rng)
        low, high = np.quantile(drawn, tail_levels(self.confidence))
        return float(low), float(high) + above

    def _variance_parts(self) -> dict[tuple[str, str], float]:
        """Return R_i^2 times the parts of the variance of log R_i, by source and scenario."""
        parts: dict[tuple[str, str], float] = {}
        rates = self.determined
        for rate in rates:
            weight, variance = rate.per_million_km, rate.log_variance
            base = weight * math.sqrt(variance.base)
            same = [other for other in rates if other is rate or (rate.fitted_to and other.fitted_to == rate.fitted_to)]
            shared = sum(other.per_million_km * math.sqrt(other.log_variance.base) for other in same)
            for key, part in {
                ("base", rate.scenario): base * shared,
                ("site", rate.scenario): weight**2 * variance.site,
                ("counts", ""): weight**2 * variance.counts,
                ("sampling", ""): weight**2 * variance.sampling,
            }.items():
                parts[key] = parts.get(key, 0.0) + part
        return parts
