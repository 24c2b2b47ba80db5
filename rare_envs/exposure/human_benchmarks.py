"""Contacts and near-crashes of human drivers in naturalistic studies, as counted, with sources and exact words.

A simulated collision is a contact at any speed: these counts of contacts seen on video are what to compare it with, not
crashes reported to the police, which are 7 to 10 times fewer.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from scipy.special import chdtri, gammaincinv

KM_PER_MILE = 1.609344
CONFIDENCE = 0.95


@dataclass(frozen=True, kw_only=True)
class HumanBenchmark:
    """Events of one kind that human drivers had in a study.

    Example:
        >>> low, high = CONTACTS_100CAR.interval_per_million_km
        >>> f"{CONTACTS_100CAR.per_million_km:.0f} ({low:.0f} to {high:.0f}) {CONTACTS_100CAR.kind}"
        '21 (16 to 27) contacts of all kinds'
    """

    study: str
    kind: str
    """Kind of events, in the plural."""
    count: int
    miles: float
    """Distance driven."""
    hours: float | None
    """Time driven; None where it is not given."""
    source: str
    words: str
    """Words of the source, or how the count was made."""

    @property
    def per_million_km(self) -> float:
        """Events per million kilometres."""
        return 1e6 * self.count / (self.miles * KM_PER_MILE)

    @property
    def per_hour(self) -> float | None:
        """Events per hour; None where the hours are not given."""
        return None if self.hours is None else self.count / self.hours

    @property
    def interval_per_million_km(self) -> tuple[float, float]:
        """Exact Poisson interval of `per_million_km`, 95 %; the distance is taken as exact."""
        tail = 0.5 - CONFIDENCE / 2
        scale = 1e6 / (self.miles * KM_PER_MILE)
        low = float(gammaincinv(self.count, tail)) if self.count else 0.0
        return scale * low, scale * float(chdtri(2 * self.count + 2, tail)) / 2

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        rates = {"per_million_km": self.per_million_km, "interval_per_million_km": list(self.interval_per_million_km)}
        return {**asdict(self), **rates, "per_hour": self.per_hour}


def _count_100car(kind: str, count: int, how: str) -> HumanBenchmark:
    """Return a count of the 100-Car study; all of its roads, since its exposure by type of road is not known."""
    return HumanBenchmark(
        study="100-Car",
        kind=kind,
        count=count,
        miles=2_000_000.0,
        hours=43_000.0,
        source="Virginia Tech Transportation Institute, Researcher Dictionary for Video Reduction Data 1.3, page 4",
        words=f'"approximately 2,000,000 vehicles miles and 43,000 hours"; {how}, counted in the published table '
        "of 828 events",
    )


def _count_shrp2(kind: str, count: int) -> HumanBenchmark:
    return HumanBenchmark(
        study="SHRP 2",
        kind=kind,
        count=count,
        miles=34.5e6,
        hours=None,
        source="Kidd and McCartt 2015 (crashes); Ali, dissertation, Virginia Tech, 2023 (miles)",
        words="\"Of 1,465 crashes ... 248 were severe ...; 597 were 'minor;' and 620 were 'low-risk tire strikes'\"; "
        '"34.5 million miles"; the two from different papers',
    )


CONTACTS_100CAR = _count_100car("contacts of all kinds", 68, "68 crashes, every contact")
REAR_END_CONTACTS_100CAR = _count_100car("contacts into a vehicle ahead", 14, "rear-end, striking: 14 crashes")
CUT_IN_CONTACTS_100CAR = _count_100car("contacts begun by another's lane change", 1, "1 crash")
REAR_END_NEAR_CRASHES_100CAR = _count_100car("near-crashes with a vehicle ahead", 385, "rear-end, striking: 385")
CUT_IN_NEAR_CRASHES_100CAR = _count_100car("near-crashes begun by another's lane change", 136, "136 near-crashes")
CONTACTS_SHRP2 = _count_shrp2("crashes without tyre strikes", 248 + 597)
HUMAN_BENCHMARKS = (
    CONTACTS_100CAR,
    REAR_END_CONTACTS_100CAR,
    CUT_IN_CONTACTS_100CAR,
    _count_100car("near-crashes", 760, "760 near-crashes"),
    REAR_END_NEAR_CRASHES_100CAR,
    CUT_IN_NEAR_CRASHES_100CAR,
    CONTACTS_SHRP2,
    _count_shrp2("severe crashes", 248),
)
"""All of them."""


def describe_human_contacts() -> str:
    """Return the figures that stand beside a rate of collisions, per million km.

    Example:
        >>> describe_human_contacts()
        'people: 21 contacts of all kinds, 4.3 into a vehicle ahead (100-Car), 15 crashes without tyre strikes (SHRP 2)'
    """
    return (
        f"people: {CONTACTS_100CAR.per_million_km:.2g} contacts of all kinds, "
        f"{REAR_END_CONTACTS_100CAR.per_million_km:.2g} into a vehicle ahead (100-Car), "
        f"{CONTACTS_SHRP2.per_million_km:.2g} {CONTACTS_SHRP2.kind} (SHRP 2)"
    )


def summarise_human_contacts() -> str:
    """Return the range of those figures in a few words, per million km.

    Example:
        >>> summarise_human_contacts()
        'people 15 to 21 (contacts at any speed)'
    """
    low, high = sorted((CONTACTS_SHRP2.per_million_km, CONTACTS_100CAR.per_million_km))
    return f"people {low:.2g} to {high:.2g} (contacts at any speed)"
