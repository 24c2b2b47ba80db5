"""Exposure: from a probability per event to collisions per hour and per kilometre.

With lambda the frequency of the events and p the probability that one of them ends in a collision, the rate is
R = lambda p. Both factors are wide, so that errors add up in logarithms:

    sd(log R)^2 = 1 / n + (1 - q) / (q k) + cov^2 + s^2 + s_site^2,    R exp(-z sd) to R exp(z sd),

for n counted events of which a share q, known from k others, is as the scenario describes; cov of the estimate; s the
spread of log p over the refits of the base distribution, with the bias of a fit; s_site the spread between sites.
Where refits are known, cov and s count (t / z)^2 fold: t is the quantile of Student's t for as few clusters of events.

Where p has an interval of its own, with other distances below and above log p (families of refits, the share that a
search may have missed), each side adds up by itself (Zou, Donner, "Construction of confidence limits about effect
measures: a general approach", Statistics in Medicine 27, 2008):

    log R_low = log R - sqrt((log p - log p_low)^2 + z^2 (1 / n + (1 - q) / (q k) + s_site^2)),

and in the same way upwards. For an interval p exp(-+ t S) that is the formula above.

Rates of several scenarios are added, with their variances, not their logarithms. As they are wide and skewed, the
interval is that of the sum of draws from each. Scenarios whose bases were fitted to the same events share that error. A
scenario whose p is not determined (nothing failed, or its events do not determine p) raises the upper end alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.events import EventFrequency

__all__ = ["CollisionProbability", "CollisionRate", "TotalRate", "VarianceShare"]

SOURCE_FIELDS = ("site", "date", "data", "licence")
"""Of a record: its entries, or those of its `source`."""


def read_source(record: Mapping[str, Any]) -> dict[str, str]:
    """Return what a record, the provenance of a base, says of its source in `SOURCE_FIELDS`; empty where nothing."""
    source = record.get("source", {})
    inner = source if isinstance(source, Mapping) else {"data": source}
    return {name: str(inner.get(name, record.get(name, "")) or "") for name in SOURCE_FIELDS}


def read_site(record: Mapping[str, Any]) -> str:
    """Return the site of a record, or its data where no site is named; empty if neither is."""
    source = read_source(record)
    return source["site"] or source["data"]


def explain_no_frequency(record: Mapping[str, Any]) -> str:
    """Return why the events of a base distribution have no frequency."""
    source = record.get("source", {})
    reason = source.get("no_frequency") if isinstance(source, Mapping) else None
    return str(reason or "nobody counted how often its events happen")


RateInterval = tuple[float, float]
FEW_EVENTS = 10
"""Counts below which a frequency is not normal in its logarithm: then it is Gamma(n + 1/2) distributed."""
RATE_DRAWS = 200_000
"""Draws for intervals that have no closed form; the ends have an error of about 1 % for an interval of a factor 10."""
MILLION_KM = 1e6


@dataclass(frozen=True, kw_only=True)
class CollisionProbability:
    """Probability of a collision per event, with what is known of its error.

    Example:
        >>> CollisionProbability(p=1.8e-5, cov=0.02, upper=2e-5, spread=1.1).determined
        True
    """

    p: float
    cov: float
    """Coefficient of variation of the estimate; any value where p = 0."""
    upper: float
    """Upper end of p: of the sampling interval, or where the events do not determine p, its bound."""
    spread: float | None = None
    """Standard deviation of log p over the refits of the base; None where it is not known."""
    fit_bias: float = 0.0
    """Bias of the fit itself in log p, which counts beside the spread."""
    quantile: float | None = None
    """Quantile of Student's t for the number of clusters of events; None for that of a normal distribution."""
    interval: RateInterval | None = None
    """Interval of p with all these errors, of the confidence of the rate; None for that which they give alike below and
    above log p."""
    determined: bool = True
    """Whether the events behind the base determine p; if not, `upper` alone is known."""


@dataclass(frozen=True, kw_only=True)
class CollisionRate:
    """Collisions per hour and per million km in one scenario.

    Example:
        Brakings of the vehicle ahead happen 47.5 times an hour; two in 100,000 end in a collision.

        >>> counted = EventFrequency(count=268, hours=5.64, km=218.0, definition="brakings", source="US 101")
        >>> p = CollisionProbability(p=1.8e-5, cov=0.02, upper=2e-5)
        >>> rate = CollisionRate(scenario="hard_brake", probability=p, frequency=counted)
        >>> low, high = rate.interval_per_hour
        >>> f"{rate.per_hour:.1e} per hour, {low:.1e} to {high:.1e}"
        '8.6e-04 per hour, 7.5e-04 to 9.7e-04'
    """

    scenario: str
    """Name of the scenario."""
    probability: CollisionProbability
    frequency: EventFrequency
    """How often its events happen."""
    site_log_sd: float = 0.0
    """Standard deviation of log R between sites; 0 for the rate at the site of the base."""
    confidence: float = 0.95
    """Nominal coverage of the intervals."""
    fitted_to: str = ""
    """Events that the base was fitted to: scenarios with the same ones share the error of their bases."""

    @property
    def per_hour(self) -> float:
        """Collisions per hour of driving."""
        return self.frequency.per_hour * self.probability.p

    @property
    def per_million_km(self) -> float:
        """Collisions per million kilometres."""
        return MILLION_KM * self.frequency.per_km * self.probability.p

    @property
    def determined(self) -> bool:
        """Whether the rate has an interval on both sides: something failed, and the events determine p."""
        return self.probability.determined and self.probability.p > 0

    @property
    def log_variance(self) -> dict[str, float]:
        """Parts of the variance of log R; of them the interval is made where p has none of its own.

        From the number of counted events, the number of simulations, the events that the base was fitted to, and the
        difference between sites.
        """
        one = self.probability
        factor = 1.0 if one.quantile is None else (one.quantile / normal_quantile(self.confidence)) ** 2
        spread = 0.0 if one.spread is None else one.spread**2 + one.fit_bias**2
        return {
            "counts": self.frequency.log_sd**2,
            "sampling": factor * one.cov**2,
            "base": factor * spread,
            "site": self.site_log_sd**2,
        }

    @property
    def interval_per_hour(self) -> RateInterval:
        """Interval of `per_hour`; from 0 where p is not determined."""
        return self._scale_interval(1.0 / self.frequency.hours)

    @property
    def interval_per_million_km(self) -> RateInterval:
        """Interval of `per_million_km`; from 0 where p is not determined."""
        return self._scale_interval(MILLION_KM / self.frequency.km)

    @property
    def shares(self) -> dict[str, float]:
        """Parts of the variance of log R as shares of it; empty where the rate is not determined."""
        if not self.determined:
            return {}
        parts = self.log_variance
        return {name: float(part / sum(parts.values())) for name, part in parts.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        frequency = self.frequency
        return {
            "scenario": self.scenario,
            "p": self.probability.p,
            "p_interval": None if self.probability.interval is None else list(self.probability.interval),
            "per_hour": self.per_hour,
            "interval_per_hour": list(self.interval_per_hour),
            "per_million_km": self.per_million_km,
            "interval_per_million_km": list(self.interval_per_million_km),
            "confidence": self.confidence,
            "determined": self.determined,
            "spread": self.probability.spread,
            "site_log_sd": self.site_log_sd,
            "shares_of_variance": self.shares,
            "frequency": {**asdict(frequency), "per_hour": frequency.per_hour, "per_km": frequency.per_km},
            "fitted_to": self.fitted_to,
        }

    def draw(self, exposure: float, base_normal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw rates (n,) from the distribution that the interval describes; of p at its upper end if not determined.

        Args:
            exposure: Hours, or kilometres, in which the events were counted; the rate is per unit of it.
            base_normal: Standard normal errors of the base distribution, shape (n,), which scenarios may share.
            rng: Source of the other errors.
        """
        n, parts, counted = len(base_normal), self.log_variance, self.frequency
        few = counted.count < FEW_EVENTS
        events = rng.gamma(counted.count + 0.5, size=n) if few else np.full(n, float(counted.count))
        counts = max(parts["counts"] - 1 / counted.count, 0.0) if few else parts["counts"]  # few: of the share alone
        log_events = math.log(counted.share) + np.log(events) + math.sqrt(counts) * rng.standard_normal(n)
        other = math.sqrt(parts["site"]) * rng.standard_normal(n)
        if self.determined:
            (below, above), z = self._log_distances(), normal_quantile(self.confidence)
            own = parts["sampling"] + parts["base"]
            of_base = parts["base"] / own if own > 0 else 0.0
            error = math.sqrt(of_base) * base_normal + math.sqrt(1.0 - of_base) * rng.standard_normal(n)
            log_p = math.log(self.probability.p) + np.where(error < 0, below, above) / z * error + other
        else:
            log_p = math.log(self.probability.upper) + other
        return np.exp(log_events + np.minimum(log_p, 0.0)) / exposure  # a probability is 1 at most

    def _scale_interval(self, scale: float) -> RateInterval:
        """Return the interval of count x share x p, times a scale."""
        counted, z = self.frequency, normal_quantile(self.confidence)
        if counted.count < FEW_EVENTS:
            rng = np.random.default_rng(0)
            drawn = scale * self.draw(1.0, rng.standard_normal(RATE_DRAWS), rng)
            low, high = (float(end) for end in np.quantile(drawn, tail_levels(self.confidence)))
            return (low if self.determined else 0.0), high
        parts, events = self.log_variance, scale * counted.count * counted.share
        most = math.exp(z * math.sqrt(parts["counts"]))  # p is 1 at most, at any site
        rest = z * math.sqrt(parts["counts"] + parts["site"])
        if not self.determined:
            return 0.0, events * min(self.probability.upper * math.exp(rest), most)
        below, above = (float(np.exp(np.hypot(distance, rest))) for distance in self._log_distances())
        return events * self.probability.p / below, events * min(self.probability.p * above, most)

    def _log_distances(self) -> RateInterval:
        """Return how far the ends of the interval of p are below and above log p > -inf."""
        one, parts = self.probability, self.log_variance
        if one.interval is None:
            half = normal_quantile(self.confidence) * math.sqrt(parts["sampling"] + parts["base"])
            return half, half
        low, high = one.interval
        return math.log(one.p / low) if low > 0 else math.inf, math.log(high / one.p)


def normal_quantile(confidence: float) -> float:
    """Return z: a normal variable is within z standard deviations with this probability."""
    return float(ndtri(0.5 + confidence / 2))


def tail_levels(confidence: float) -> RateInterval:
    """Return the levels of the two quantiles between which a variable is with this probability."""
    return 0.5 - confidence / 2, 0.5 + confidence / 2


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


@dataclass(frozen=True)
class TotalRate:
    """Collisions per hour and per million km over scenarios that count nothing twice.

    Example:
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
        return self._interval("interval_per_hour", [rate.frequency.hours for rate in self.rates])

    @cached_property
    def interval_per_million_km(self) -> RateInterval:
        """Interval of `per_million_km`."""
        return self._interval("interval_per_million_km", [rate.frequency.km / MILLION_KM for rate in self.rates])

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
        parts: dict[tuple[str, str], float] = {}
        rates = self.determined
        for rate in rates:
            weight, variance = rate.per_million_km, rate.log_variance
            base = weight * math.sqrt(variance["base"])
            same = [other for other in rates if other is rate or (rate.fitted_to and other.fitted_to == rate.fitted_to)]
            shared = sum(other.per_million_km * math.sqrt(other.log_variance["base"]) for other in same)
            for key, part in {
                ("base", rate.scenario): base * shared,
                ("site", rate.scenario): weight**2 * variance["site"],
                ("counts", ""): weight**2 * variance["counts"],
                ("sampling", ""): weight**2 * variance["sampling"],
            }.items():
                parts[key] = parts.get(key, 0.0) + part
        total = sum(parts.values())
        found = [VarianceShare(source, name, float(part / total)) for (source, name), part in parts.items() if part > 0]
        return tuple(sorted(found, key=lambda each: -each.share))

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

    def _interval(self, name: str, exposures: list[float]) -> RateInterval:
        """Return the interval of the sum of the determined rates, and above it the upper ends of the others.

        Each rate has its own interval of this name, per unit of its exposure.
        """
        single: list[RateInterval] = [getattr(rate, name) for rate in self.rates]
        if len(single) == 1:
            return single[0]
        rng = np.random.default_rng(0)
        groups: dict[str, FloatArray] = {}
        drawn, above = np.zeros(RATE_DRAWS), 0.0
        for number, (rate, exposure, (_, high)) in enumerate(zip(self.rates, exposures, single, strict=True)):
            if not rate.determined:
                above += high
                continue
            key = rate.fitted_to or f"scenario {number}"
            groups.setdefault(key, rng.standard_normal(RATE_DRAWS))
            drawn += rate.draw(exposure, groups[key], rng)
        low, high = np.quantile(drawn, tail_levels(self.confidence))
        return float(low), float(high) + above
