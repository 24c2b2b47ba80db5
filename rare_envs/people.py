"""People: what they had in naturalistic studies, and the human driver model beside them in each kind of event.

What to compare a simulated collision, a contact at any speed, with are the contacts of such studies, seen on video.
Crashes reported to the police are 7 to 10 times fewer.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib import resources
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

from scipy.special import chdtri, gammaincinv

from rare_envs.exposure import MILLION_KM, CollisionRate, RateInterval

__all__ = [
    "HUMAN_BENCHMARKS",
    "EventCalibration",
    "HumanBenchmark",
    "ModelCount",
    "PeopleInEvent",
    "calibration",
    "people_in",
]

KM_PER_MILE = 1.609344
CONFIDENCE = 0.95


@dataclass(frozen=True, kw_only=True)
class HumanBenchmark:
    """Events of one kind that human drivers had in a study.

    Example:
        >>> low, high = CONTACTS_100CAR.interval_per_million_km
        >>> f"{CONTACTS_100CAR.per_million_km:.0f} ({low:.0f} to {high:.0f}) {CONTACTS_100CAR.kind}"
        '21 (16 to 27) contacts of all kinds'
        >>> p, (low, high) = people_in("cut_in").contacts.per_event(0.26)  # cut-ins per km on US 101
        >>> f"{p:.1e} ({low:.1e} to {high:.1e})"
        '1.2e-06 (3.0e-08 to 6.7e-06)'
    """

    study: str
    kind: str
    """Kind of events, in the plural."""
    count: int
    miles: float
    """Distance driven."""
    source: str
    words: str
    """Words of the source, or how the count was made."""

    @property
    def per_million_km(self) -> float:
        """Events per million kilometres."""
        return MILLION_KM * self.count / (self.miles * KM_PER_MILE)

    @property
    def interval_per_million_km(self) -> RateInterval:
        """`interval_at` 95 %."""
        return self.interval_at(CONFIDENCE)

    def interval_at(self, confidence: float) -> RateInterval:
        """Return the exact Poisson interval of `per_million_km`; the distance is taken as exact."""
        tail = 0.5 - confidence / 2
        scale = MILLION_KM / (self.miles * KM_PER_MILE)
        low = float(gammaincinv(self.count, tail)) if self.count else 0.0
        return scale * low, scale * float(chdtri(2 * self.count + 2, tail)) / 2

    def per_event(self, events_per_km: float) -> tuple[float, RateInterval]:
        """Return the probability per event and its interval, of events that happen so often; their count is exact."""
        scale = 1.0 / MILLION_KM / events_per_km
        low, high = self.interval_per_million_km
        return scale * self.per_million_km, (scale * low, scale * high)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        rates = {"per_million_km": self.per_million_km, "interval_per_million_km": list(self.interval_per_million_km)}
        return {**asdict(self), **rates}


Event: TypeAlias = Literal["cut_in", "stop", "slowing"]
"""Another's lane change; a lead that brakes to a standstill; a lead that brakes without one."""
Outcome: TypeAlias = Literal["contacts", "near_crashes"]


class PeopleInEvent(NamedTuple):
    """What people had in events of one kind.

    Example:
        >>> people = people_in("slowing")
        >>> low, high = people.contacts.interval_per_million_km
        >>> f"{people.contacts.count}, below {high:.1f} per million km; {people.near_crashes.count} near-crashes"
        '0, below 1.1 per million km; 152 near-crashes'
    """

    contacts: HumanBenchmark
    near_crashes: HumanBenchmark


def _read_counts() -> dict[str, HumanBenchmark]:
    """Return what was counted, by name; in the 100-Car study on all roads, since its exposure by type is not known."""
    text = (resources.files("rare_envs") / "data" / "human_counts.json").read_text("utf-8")
    found = json.loads(text)
    return {name: HumanBenchmark(**found["studies"][each.pop("of")], **each) for name, each in found["counts"].items()}


_COUNTS = _read_counts()
CONTACTS_100CAR = _COUNTS["contacts"]
UNSEEN_CHANGES_100CAR = _COUNTS["near_crashes of own changes unseen"]
HUMAN_BENCHMARKS = tuple(_COUNTS.values())
"""All of them."""


def people_in(event: Event) -> PeopleInEvent:
    """Return people's contacts and near-crashes in one kind of event (100-Car, by precipitating event).

    Five near-crashes with a lead "at a slower constant speed" belong to none of them.

    Raises:
        KeyError: If there is no such event.

    Example:
        >>> people_in("stop").contacts.count, people_in("stop").near_crashes.count
        (13, 132)
    """
    return PeopleInEvent(_COUNTS[f"{event} contacts"], _COUNTS[f"{event} near_crashes"])


CALIBRATED_WITHIN = 3.0
"""Factor within which the human driver model has to meet people's interval for a rate to count as calibrated."""


class ModelCount(NamedTuple):
    """Probability per event that the human driver model ends it in a contact, or in a near-crash.

    Example:
        >>> ModelCount(p=2.0e-5, low=1.0e-5, high=3.0e-5).factor_from(4e-6, 1e-5)
        2.0
    """

    p: float
    low: float
    """Ends of its sampling interval, 95 %."""
    high: float

    def factor_from(self, low: float, high: float) -> float:
        """Return how many times it is above the upper limit of an interval, or below the lower one (then under 1).

        1 inside. Where nothing was counted the upper limit of its own interval counts: it may be so many times above.
        """
        p = self.p if self.p > 0 else self.high
        return p / low if p < low else max(p / high, 1.0)


@dataclass(frozen=True, kw_only=True)
class EventCalibration:
    """The human driver model beside people in one kind of event, as `benchmarks.driving.human_calibration` measured it.

    Example:
        >>> counts = {"human": {"contacts": ModelCount(1.5e-5, 0.7e-5, 2.8e-5)}}
        >>> found = EventCalibration(event="cut_in", base="us101", per_km=0.26, drivers=counts)
        >>> f"{found.factor():.1f} times the upper limit of people's {found.people('contacts')[1][1]:.1e}"
        "2.3 times the upper limit of people's 6.7e-06"
        >>> found.is_calibrated  # within a factor of 3
        True
    """

    event: Event
    base: str
    """Name of the traffic model."""
    per_km: float
    """Frequency of the events."""
    drivers: Mapping[str, Mapping[str, ModelCount]]
    """Contacts and near-crashes per event of "human" and "human:no-headway-rule", by `Outcome`."""

    def people(self, outcome: Outcome) -> tuple[float, RateInterval]:
        """Return people's probability per event and its interval."""
        benchmark: HumanBenchmark = getattr(people_in(self.event), outcome)
        return benchmark.per_event(self.per_km)

    def factor(self, outcome: Outcome = "contacts", driver: str = "human") -> float:
        """Return the factor by which a driver misses people's interval per event; see `ModelCount.factor_from`."""
        return self.drivers[driver][outcome].factor_from(*self.people(outcome)[1])

    def describe_factor(self, outcome: Outcome = "contacts") -> str:
        """Return the factor, as "7.5 times above people's interval", or that it may be so if nothing was counted."""
        factor, count = self.factor(outcome), self.drivers["human"][outcome]
        if factor == 1.0:
            return "inside people's interval"
        way = f"{factor:.2g} times above" if factor > 1.0 else f"{1.0 / factor:.2g} times below"
        return f"{'' if count.p > 0 or factor < 1.0 else 'may be '}{way} people's interval"

    @property
    def is_calibrated(self) -> bool:
        """Whether `human` has contacts within a factor `CALIBRATED_WITHIN` of people's interval."""
        return 1.0 / CALIBRATED_WITHIN <= self.factor() <= CALIBRATED_WITHIN

    def per_million_km(self, driver: str = "human") -> ModelCount:
        """Return contacts per million km of a driver, with their interval."""
        return ModelCount(*(MILLION_KM * self.per_km * each for each in self.drivers[driver]["contacts"]))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        contacts = {driver: self.per_million_km(driver)._asdict() for driver in self.drivers}
        return {"base": self.base, "factor": self.factor(), "contacts_per_million_km": contacts}


@cache
def calibration(event: Event, base: str) -> EventCalibration | None:
    """Return the calibration of the human driver model in events of one kind; None if nobody measured it.

    Args:
        event: The kind of event.
        base: Name of the traffic model, such as "us101".

    Example:
        >>> calibration("stop", "us101").is_calibrated, calibration("cut_in", "i80").is_calibrated
        (True, False)
        >>> calibration("cut_in", "us101-test") is None
        True
    """
    path = resources.files("rare_envs") / "data" / "human_calibration.json"
    found = json.loads(path.read_text("utf-8"))["events"].get(event, {}).get(base)
    if found is None:
        return None
    drivers = {
        driver: {outcome: ModelCount(*count) for outcome, count in counts.items()}
        for driver, counts in found["drivers"].items()
    }
    return EventCalibration(event=event, base=base, per_km=found["per_km"], drivers=drivers)


MODEL, NO_HEADWAY_RULE = "human", "human:no-headway-rule"
"""The human driver model, and the same whose glances may be longer than the headway; people need not lie between."""
COUNTED: tuple[str, ...] = get_args(Event)
"""Events of which people's contacts were counted."""


@dataclass(frozen=True, kw_only=True)
class EventRate:
    """Collisions of an ego in one kind of event.

    Strata of a traffic model that bear the name of an event of which people's contacts were counted, such as the
    brakings to a standstill among all, are events of their own; others are parts of the scenario's one event. The rate
    of a part is the frequency of the scenario's events times its share times its p.
    """

    event: str
    """One of `COUNTED`, or the name of a scenario."""
    rate: CollisionRate
    share: float
    """Share of the scenario's events that are of this kind."""
    parts: Mapping[str, float]
    """Shares of the rate by stratum; empty if there is one stratum, or nothing failed."""
    unresolved: Mapping[str, float] = field(default_factory=dict)
    """Upper limits of the rate [per million km] in strata that are not resolved, see `samplers.method.Part`; that of an
    event which is such a stratum under its own name."""
    traffic: str
    """The traffic model, and the options that make other traffic of it."""
    calibration: EventCalibration | None
    """The human driver model in this event and traffic; None if nobody has measured it."""

    @property
    def people(self) -> HumanBenchmark | None:
        """Contacts of people in the same event; None if nobody has counted them."""
        return people_in(self.event).contacts if self.event in COUNTED else None  # type: ignore[arg-type]

    @property
    def uncalibrated(self) -> str:
        """Why the rate is not calibrated: the human driver model misses people, or was not measured; empty if it is."""
        if self.calibration is None:
            return f"no calibration of {self.traffic}"
        return "" if self.calibration.is_calibrated else f"uncalibrated, {self.calibration.describe_factor()}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "event": self.event,
            "share_of_events": self.share,
            **self.rate.to_dict(),
            "parts": dict(self.parts),
            "unresolved": dict(self.unresolved),
            "people": None if self.people is None else self.people.to_dict(),
            "uncalibrated": self.uncalibrated,
            "calibration": None if self.calibration is None else self.calibration.to_dict(),
        }


def sum_people(events: Sequence[EventRate]) -> HumanBenchmark | None:
    """Return people's contacts in several kinds of event together; None if one of them was not counted."""
    return add_people([each.people for each in events])


def add_people(counted: Sequence[HumanBenchmark | None]) -> HumanBenchmark | None:
    """Return contacts of several kinds of event together; None if one of them was not counted."""
    known = [each for each in counted if each is not None]
    if not known or len(known) < len(counted):
        return None
    kinds = ", ".join(each.kind for each in known)
    return replace(known[0], count=sum(each.count for each in known), kind=kinds, words="sum of the kinds of event")
