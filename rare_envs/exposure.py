"""Exposure: from a probability per event to collisions per million kilometres.

With lambda the frequency of the events and p the probability that one of them ends in a collision, the rate is
R = lambda p. Both factors are wide, so that errors add up in logarithms:

    sd(log R)^2 = 1 / n + (1 - q) / (q k) + s_p^2 + s^2 + s_site^2,    R exp(-z sd) to R exp(z sd),

for n counted events of which a share q, known from k others, is as the scenario describes; s_p the c.o.v. of the
estimate of p; s the spread of log p over the refits of the traffic model, with the bias of a fit; s_site the spread
between sites. If refits are known, s_p and s are t / z fold: t is the quantile of Student's t for as few clusters of
events.

If p has an interval of its own, with other distances below and above log p (families of refits, the share that a
search may have missed), each side adds up by itself (Zou, Donner, "Construction of confidence limits about effect
measures: a general approach", Statistics in Medicine 27, 2008):

    log R_low = log R - sqrt((log p - log p_low)^2 + z^2 (1 / n + (1 - q) / (q k) + s_site^2)),

and in the same way upwards.

Rates of several scenarios are added, with their variances, not their logarithms. As they are wide and skewed, the
interval is that of the sum of draws from each. Scenarios whose bases were fitted to the same events share that error. A
scenario whose p is not determined (nothing failed, or its events do not determine p) raises the upper limit alone.
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

__all__ = ["CollisionRate", "TotalRate", "VarianceShare"]

SOURCE_FIELDS = ("site", "date", "data", "licence")
"""Of a record: its entries, or those of its `source`."""


def read_source(record: Mapping[str, Any]) -> dict[str, str]:
    """Return what a record, the provenance of a base, says of its source in `SOURCE_FIELDS`; empty if nothing."""
    source = record.get("source", {})
    inner = source if isinstance(source, Mapping) else {"data": source}
    return {name: str(inner.get(name, record.get(name, "")) or "") for name in SOURCE_FIELDS}


def read_site(record: Mapping[str, Any]) -> str:
    """Return the site of a record, or its data if no site is named; empty if neither is."""
    source = read_source(record)
    return source["site"] or source["data"]


def explain_no_frequency(record: Mapping[str, Any]) -> str:
    """Return why the events of a traffic model have no frequency."""
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
class CollisionRate:
    """Collisions per million km in one scenario.

    Raises:
        ValueError: p is 0 and has no interval.

    Example:
        Brakings of the vehicle ahead happen 1.29 times per km; two in 100,000 end in a collision.

        >>> counted = EventFrequency(count=283, hours=5.746, km=219.0, definition="brakings", source="US 101")
        >>> rate = CollisionRate(scenario="hard_brake", frequency=counted, p=1.8e-5, sampling_log_sd=0.02)
        >>> low, high = rate.interval_per_million_km
        >>> f"{rate.per_million_km:.0f} per million km, {low:.0f} to {high:.0f}"
        '23 per million km, 21 to 26'
    """

    scenario: str
    """Name of the scenario."""
    frequency: EventFrequency
    """How often its events happen."""
    p: float
    """Probability that an event ends in a collision."""
    sampling_log_sd: float = 0.0
    """Standard deviation of log p by the number of simulations, t / z fold where that counts."""
    base_log_sd: float = 0.0
    """The same by the events that the base was fitted to; 0 where it is not known."""
    interval: RateInterval | None = None
    """Interval of p with these errors, of the confidence of the rate; it begins at 0 if p is not determined. None
    for that which the deviations give alike below and above log p."""
    site_log_sd: float = 0.0
    """Standard deviation of log R between sites; 0 for the rate at the site of the base."""
    confidence: float = 0.95
    """Nominal coverage of the intervals."""
    fitted_to: str = ""
    """Events that the base was fitted to: scenarios with the same ones share the error of their bases."""

    def __post_init__(self) -> None:
        if self.p <= 0 and self.interval is None:
            raise ValueError(f"Expected an interval of p = {self.p:g}: nothing else gives its upper limit.")

    @property
    def per_million_km(self) -> float:
        """Collisions per million kilometres."""
        return MILLION_KM * self.frequency.per_km * self.p

    @property
    def determined(self) -> bool:
        """Whether the rate has an interval on both sides: something failed, and the events determine p."""
        return self.p > 0 and (self.interval is None or self.interval[0] > 0)

    @property
    def limited(self) -> bool:
        """Whether the rate has a limit: an upper one below the rate of the events, or a lower one."""
        return self.determined or self.interval is None or self.interval[1] < 1.0

    @property
    def log_variance(self) -> dict[str, float]:
        """Parts of the variance of log R.

        From the number of counted events, the number of simulations, the events that the base was fitted to, and the
        difference between sites.
        """
        deviations = {"sampling": self.sampling_log_sd, "base": self.base_log_sd, "site": self.site_log_sd}
        return {"counts": self.frequency.log_sd**2, **{name: sd**2 for name, sd in deviations.items()}}

    @property
    def interval_per_million_km(self) -> RateInterval:
        """Interval of `per_million_km`; from 0 if p is not determined."""
        counted, z = self.frequency, normal_quantile(self.confidence)
        if counted.count < FEW_EVENTS:
            rng = np.random.default_rng(0)
            drawn = self.draw(rng.standard_normal(RATE_DRAWS), rng)
            low, high = (float(end) for end in np.quantile(drawn, tail_levels(self.confidence)))
            return (low if self.determined else 0.0), high
        scale, rest = MILLION_KM * counted.per_km, z * math.hypot(counted.log_sd, self.site_log_sd)
        most = math.exp(z * counted.log_sd)  # p is 1 at most, at any site
        if self.interval is not None and not self.determined:
            return 0.0, scale * min(self.interval[1] * math.exp(rest), most)
        below, above = (math.exp(math.hypot(distance, rest)) for distance in self._log_distances())
        return scale * self.p / below, scale * min(self.p * above, most)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        frequency = self.frequency
        return {
            "scenario": self.scenario,
            "p": self.p,
            "p_interval": None if self.interval is None else list(self.interval),
            "per_million_km": self.per_million_km,
            "interval_per_million_km": list(self.interval_per_million_km),
            "confidence": self.confidence,
            "determined": self.determined,
            "site_log_sd": self.site_log_sd,
            "log_variance": self.log_variance,
            "frequency": {**asdict(frequency), "per_hour": frequency.per_hour, "per_km": frequency.per_km},
            "fitted_to": self.fitted_to,
        }

    def draw(self, base_normal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw rates (n,) from the distribution that the interval describes; of p at its upper limit if not determined.

        Args:
            base_normal: Standard normal errors of the traffic model, shape (n,), which scenarios may share.
            rng: Source of the other errors.
        """
        n, parts, counted = len(base_normal), self.log_variance, self.frequency
        few = counted.count < FEW_EVENTS
        events = rng.gamma(counted.count + 0.5, size=n) if few else np.full(n, float(counted.count))
        counts = max(parts["counts"] - 1 / counted.count, 0.0) if few else parts["counts"]  # few: of the share alone
        log_events = math.log(counted.share) + np.log(events) + math.sqrt(counts) * rng.standard_normal(n)
        log_p = self.site_log_sd * rng.standard_normal(n)
        if self.interval is not None and not self.determined:
            log_p += math.log(self.interval[1])
        else:
            (below, above), z = self._log_distances(), normal_quantile(self.confidence)
            own = parts["sampling"] + parts["base"]
            of_base = parts["base"] / own if own > 0 else 0.0
            error = math.sqrt(of_base) * base_normal + math.sqrt(1.0 - of_base) * rng.standard_normal(n)
            log_p += math.log(self.p) + np.where(error < 0, below, above) / z * error
        return np.exp(log_events + np.minimum(log_p, 0.0)) * MILLION_KM / counted.km  # a probability is 1 at most

    def _log_distances(self) -> RateInterval:
        """Return how far the ends of the interval of p > 0 are below and above log p."""
        if self.interval is None:
            half = normal_quantile(self.confidence) * math.hypot(self.sampling_log_sd, self.base_log_sd)
            return half, half
        low, high = self.interval
        return math.log(self.p / low), math.log(high / self.p)


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
    """Collisions per million km over scenarios that count nothing twice.

    Example:
        >>> brakings = EventFrequency(count=42, hours=5.64, km=218.0, definition="brakings", source="US 101")
        >>> rate = CollisionRate(
        ...     scenario="hard_brake", frequency=brakings, p=1.8e-5, sampling_log_sd=0.02, base_log_sd=1.1)
        >>> total = TotalRate((rate,))
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
        """Nominal coverage of the interval."""
        return self.rates[0].confidence

    @property
    def per_million_km(self) -> float:
        """Collisions per million kilometres."""
        return sum(rate.per_million_km for rate in self.rates)

    @cached_property
    def interval_per_million_km(self) -> RateInterval:
        """Interval of `per_million_km`: of the sum of the determined rates, and above it the others' upper limits.

        No limit is below that of one of these rates: the sum is no less than it.
        """
        if len(self.rates) == 1:
            return self.rates[0].interval_per_million_km
        rng = np.random.default_rng(0)
        groups: dict[str, FloatArray] = {}
        drawn, above = np.zeros(RATE_DRAWS), 0.0
        for number, rate in enumerate(self.rates):
            if not rate.determined:
                above += rate.interval_per_million_km[1]
                continue
            key = rate.fitted_to or f"scenario {number}"
            groups.setdefault(key, rng.standard_normal(RATE_DRAWS))
            drawn += rate.draw(groups[key], rng)
        low, high = np.quantile(drawn, tail_levels(self.confidence))
        ends = [rate.interval_per_million_km for rate in self.determined] or [(0.0, 0.0)]
        return max(float(low), *(end[0] for end in ends)), max(float(high), *(end[1] for end in ends)) + above

    @property
    def determined(self) -> tuple[CollisionRate, ...]:
        """The rates with an interval on both sides."""
        return tuple(rate for rate in self.rates if rate.determined)

    @property
    def limited(self) -> bool:
        """Whether all of the rates are."""
        return all(rate.limited for rate in self.rates)

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
            "per_million_km": self.per_million_km,
            "interval_per_million_km": list(self.interval_per_million_km),
            "confidence": self.confidence,
            "shares_of_variance": [each._asdict() for each in self.shares],
        }
