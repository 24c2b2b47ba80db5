"""Frequency of the event of a scenario: a count in recordings, with its exposure and its error."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from rare_envs.distributions.reading import require_count, require_number, require_text


@dataclass(frozen=True, kw_only=True)
class EventFrequency:
    """Events counted in recordings, and the share of them that the base distribution stands for.

    With n events counted in T hours, and a share s of them estimated from m events (k = s m of which had it):

        rate = n s / T
        Var(log rate) = 1 / n + (1 - s) / (s m) = 1 / n + 1 / k - 1 / m

    The first term is a Poisson count's, the second a binomial proportion's, both to first order (delta method).

    Raises:
        ValueError: A count or an exposure is not positive, the share is not in (0, 1], or a text is missing.

    Example:
        >>> cut_ins = EventFrequency(  # 38 of 46 with both gaps in the ranges of the scenario
        ...     count=1221,
        ...     hours=112.0,
        ...     km=3900.0,
        ...     share=38 / 46,
        ...     share_events=46,
        ...     definition="lane changes into the lane ahead of a vehicle",
        ...     source="NGSIM US 101, complete",
        ... )
        >>> round(cut_ins.per_hour, 1), round(cut_ins.per_km, 2), round(cut_ins.log_sd, 3)
        (9.0, 0.26, 0.073)
    """

    count: int
    """Events counted, n."""
    hours: float
    """Vehicle-hours in which they were counted."""
    km: float
    """Vehicle-kilometres in which they were counted."""
    share: float = 1.0
    """Share of the counted events that are as the base distribution's."""
    share_events: int | None = None
    """Events of which the share is the share, m; None if it is known without error."""
    definition: str
    """What was counted, in words."""
    source: str
    """Where it was counted."""

    def __post_init__(self) -> None:
        require_count("count of the frequency", self.count)
        require_number("hours of the frequency", self.hours)
        require_number("km of the frequency", self.km)
        require_number("share of the frequency", self.share, high=1.0)
        if self.share_events is not None:
            require_count("share_events of the frequency", self.share_events)
        require_text("definition of the frequency", self.definition)
        require_text("source of the frequency", self.source)

    @property
    def per_hour(self) -> float:
        """Events per vehicle-hour."""
        return self.count * self.share / self.hours

    @property
    def per_km(self) -> float:
        """Events per vehicle-kilometre."""
        return self.count * self.share / self.km

    @property
    def log_sd(self) -> float:
        """Standard deviation of the logarithm of the rate, of the counts alone; sites differ by more."""
        share_variance = 0.0 if self.share_events is None else (1.0 - self.share) / (self.share * self.share_events)
        return math.sqrt(1.0 / self.count + share_variance)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields by name, ready for JSON."""
        return asdict(self)
