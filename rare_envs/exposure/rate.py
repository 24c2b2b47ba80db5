"""Collisions per hour and per kilometre of one scenario: its probability times the frequency of its events.

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
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from rare_envs.arrays import FloatArray
from rare_envs.distributions.fitted import EventFrequency

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


class LogVariance(NamedTuple):
    """Parts of the variance of log R.

    Example:
        >>> round(LogVariance(counts=0.01, sampling=0.0, base=2.25, site=0.0).total, 2)
        2.26
    """

    counts: float
    """From the number of counted events."""
    sampling: float
    """From the number of simulations."""
    base: float
    """From the events that the base distribution was fitted to."""
    site: float
    """From the difference between sites."""

    @property
    def total(self) -> float:
        """Their sum."""
        return sum(self)


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
    def log_variance(self) -> LogVariance:
        """Parts of the variance of log R; of them the interval is made where p has none of its own."""
        one = self.probability
        factor = 1.0 if one.quantile is None else (one.quantile / normal_quantile(self.confidence)) ** 2
        spread = 0.0 if one.spread is None else one.spread**2 + one.fit_bias**2
        return LogVariance(
            counts=self.frequency.log_sd**2,
            sampling=factor * one.cov**2,
            base=factor * spread,
            site=self.site_log_sd**2,
        )

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
        return {name: float(part / self.log_variance.total) for name, part in self.log_variance._asdict().items()}

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
            "frequency": {**frequency.to_dict(), "per_hour": frequency.per_hour, "per_km": frequency.per_km},
            "fitted_to": self.fitted_to,
        }

    def draw(self, exposure: float, base_normal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw rates from the distribution that the interval describes.

        Args:
            exposure: Hours, or kilometres, in which the events were counted; the rate is per unit of it.
            base_normal: Standard normal errors of the base distribution, shape (n,), which scenarios may share.
            rng: Source of the other errors.

        Returns:
            Rates, shape (n,); of p at its upper end where it is not determined.
        """
        n, parts, counted = len(base_normal), self.log_variance, self.frequency
        few = counted.count < FEW_EVENTS
        events = rng.gamma(counted.count + 0.5, size=n) if few else np.full(n, float(counted.count))
        counts = max(parts.counts - 1 / counted.count, 0.0) if few else parts.counts  # few: of the share alone
        log_events = math.log(counted.share) + np.log(events) + math.sqrt(counts) * rng.standard_normal(n)
        other = math.sqrt(parts.site) * rng.standard_normal(n)
        if self.determined:
            (below, above), z = self._log_distances(), normal_quantile(self.confidence)
            own = parts.sampling + parts.base
            of_base = parts.base / own if own > 0 else 0.0
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
        most = math.exp(z * math.sqrt(parts.counts))  # p is 1 at most, at any site
        rest = z * math.sqrt(parts.counts + parts.site)
        if not self.determined:
            return 0.0, events * min(self.probability.upper * math.exp(rest), most)
        below, above = (float(np.exp(np.hypot(distance, rest))) for distance in self._log_distances())
        return events * self.probability.p / below, events * min(self.probability.p * above, most)

    def _log_distances(self) -> RateInterval:
        """Return how far the ends of the interval of p are below and above log p > -inf."""
        one, parts = self.probability, self.log_variance
        if one.interval is None:
            half = normal_quantile(self.confidence) * math.sqrt(parts.sampling + parts.base)
            return half, half
        low, high = one.interval
        return math.log(one.p / low) if low > 0 else math.inf, math.log(high / one.p)


def normal_quantile(confidence: float) -> float:
    """Return z: a normal variable is within z standard deviations with this probability."""
    return float(ndtri(0.5 + confidence / 2))


def tail_levels(confidence: float) -> RateInterval:
    """Return the levels of the two quantiles between which a variable is with this probability."""
    return 0.5 - confidence / 2, 0.5 + confidence / 2
