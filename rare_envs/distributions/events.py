"""Records of the events that distributions are fitted to: how many and how often, and what speaks for a fit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, TypeVar

RecordT = TypeVar("RecordT")


def read_record(kind: type[RecordT], what: str, data: object) -> RecordT:
    """Return a frozen dataclass, whose constructor checks the values, from an object of a file (`what` in messages)."""
    names = [each.name for each in fields(kind)]  # type: ignore[arg-type]  # a dataclass
    if not isinstance(data, Mapping):
        raise ValueError(f"Expected {what} as an object with {', '.join(names)}, got {data!r}.")
    unknown = [str(name) for name in data if name not in names]
    needed = [each.name for each in fields(kind) if each.default is MISSING]  # type: ignore[arg-type]
    missing = [name for name in needed if name not in data]
    if unknown or missing:
        wrong = f"unknown {', '.join(unknown)}" if unknown else f"no {', '.join(missing)}"
        raise ValueError(f"Expected {what} as an object with {', '.join(names)}, got {wrong}.")
    return kind(**data)


def require_count(what: str, value: object, least: int = 1) -> None:
    """Raise a ValueError unless a value is a whole number, `least` or more."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"Expected {what} as a whole number, {least} or more, got {value!r}.")


def require_number(what: str, value: object, high: float = math.inf) -> None:
    """Raise a ValueError unless a value is a finite number above 0 and at most `high`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= high or math.isinf(value):
        most = "" if math.isinf(high) else f", at most {high:g}"
        raise ValueError(f"Expected {what} as a number above 0{most}, got {value!r}.")


def require_text(what: str, value: object) -> None:
    """Raise a ValueError unless a value is a text that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"Expected {what} as a text, got {value!r}.")


@dataclass(frozen=True, kw_only=True)
class EventFrequency:
    """Events counted in recordings, and the share of them that the traffic model stands for.

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
    """Share of the counted events that are as the traffic model's."""
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


@dataclass(frozen=True, kw_only=True)
class EventCounts:
    """How many events a distribution was fitted to, and in how many independent clusters they come.

    Raises:
        ValueError: A number is not positive, or there are more clusters than events.

    Example:
        >>> EventCounts(used=(38, 15), clusters=17).describe()
        '38 + 15 events of 17 scenes'
    """

    used: tuple[int, ...]
    """Events of each part of the parameters that was fitted by itself."""
    clusters: int
    """Clusters of events, independent of each other; as many as events where each event is one."""
    cluster: str = "scene"
    """Kind of cluster, a singular noun."""

    def __post_init__(self) -> None:
        if not isinstance(self.used, list | tuple) or not self.used:
            raise ValueError(f"Expected used of the events as a list of whole numbers, got {self.used!r}.")
        object.__setattr__(self, "used", tuple(self.used))
        for count in self.used:
            require_count("used of the events", count)
        require_count("clusters of the events", self.clusters)
        require_text("cluster of the events", self.cluster)
        if self.clusters > sum(self.used):
            raise ValueError(f"Expected at most as many clusters as events, {sum(self.used)}, got {self.clusters}.")

    def describe(self) -> str:
        """Return events and clusters in words."""
        total, plural = " + ".join(map(str, self.used)), "" if self.clusters == 1 else "s"
        events = f"{total} event{'' if self.used == (1,) else 's'}"
        return events if self.cluster == "event" else f"{events} of {self.clusters} {self.cluster}{plural}"


@dataclass(frozen=True)
class PredictiveCheck:
    """A count of dangerous states among the recorded events, beside the count that the distribution expects.

    Raises:
        ValueError: The recorded count is negative or not whole, or the expected one is negative.

    Example:
        >>> PredictiveCheck("TTC < 5 s", recorded=7, expected=15.9).name
        'TTC < 5 s'
    """

    name: str
    """What is counted, in words."""
    recorded: int
    """Among the recorded events."""
    expected: float
    """Among as many events of the distribution, on average."""

    def __post_init__(self) -> None:
        require_text("name of a check", self.name)
        require_count("recorded of a check", self.recorded, least=0)
        if self.expected != 0:
            require_number("expected of a check", self.expected)


def describe_checks(checks: Iterable[Mapping[str, Any]]) -> str:
    """Return recorded and expected counts, entries of predictive checks, in words.

    Example:
        >>> names = "looked: TTC < 5 s", "looked: closing"
        >>> describe_checks({"name": name, "recorded": 7, "expected": 15.94} for name in names)
        'looked: TTC < 5 s 7 / 15.94, closing 7 / 15.94'
    """
    groups: dict[str, list[str]] = {}
    for each in checks:
        stratum, _, state = each["name"].rpartition(": ")
        groups.setdefault(stratum, []).append(f"{state} {each['recorded']} / {each['expected']:.4g}")
    return "; ".join(f"{stratum}: {', '.join(texts)}".removeprefix(": ") for stratum, texts in groups.items())


def describe_motion(found: Mapping[str, Any]) -> str:
    """Return how recorded vehicles went on after an event beside simulated ones, in words.

    Example:
        >>> found = {"events": 38, "recorded": 0.225, "simulated": 0.164, "rmse": 0.682}
        >>> describe_motion(found | {"braking": 0, "of": 36, "share_simulated": 0.05})
        '0.23 m/s^2 over 2 s, simulated 0.16, rms error 0.68 (38); over 3.4 m/s^2 in 3 s 0 of 36, expected 1.8'
    """
    text = "{recorded:.2f} m/s^2 over 2 s, simulated {simulated:.2f}, rms error {rmse:.2f} ({events})".format(**found)
    if "of" not in found:
        return text
    expected = found["share_simulated"] * found["of"]
    return f"{text}; over 3.4 m/s^2 in 3 s {found['braking']} of {found['of']}, expected {expected:.2g}"
