"""Frequency of events in a user's own recordings: counts, and the time and distance of all vehicles."""

from __future__ import annotations

from dataclasses import dataclass

from rare_envs.distributions.fitted import EventFrequency
from training.data.brakings import braking_exposure
from training.data.events import Events
from training.data.table import DT, Trajectories
from training.scenario_fitting.shipped.frequencies import CUT_INS_US101, NEW_LEADERS, braking_frequency

OWN_SOURCE = "counted in the recordings themselves"


@dataclass(frozen=True)
class ObservedTraffic:
    """Time and distance of all vehicles of recordings.

    Example:
        >>> from training.data import synthetic_traffic
        >>> traffic = ObservedTraffic().plus(synthetic_traffic(seconds=10.0, per_lane=1))
        >>> round(3600 * traffic.hours, 1)  # three lanes of one vehicle each
        30.0
    """

    hours: float = 0.0
    """Vehicle-hours."""
    km: float = 0.0
    """Vehicle-kilometres."""
    braking_hours: float = 0.0
    """Vehicle-hours in which a braking could begin and be seen."""
    braking_km: float = 0.0
    """Vehicle-kilometres in that time."""

    def plus(self, table: Trajectories) -> ObservedTraffic:
        """Return the traffic with one more recording."""
        seconds, metres = len(table) * DT, float(table.speed.sum()) * DT
        braking_seconds, braking_metres = braking_exposure(table)
        return ObservedTraffic(
            self.hours + seconds / 3600.0,
            self.km + metres / 1000.0,
            self.braking_hours + braking_seconds / 3600.0,
            self.braking_km + braking_metres / 1000.0,
        )


def count_events(scenario: str, events: Events, used: int, traffic: ObservedTraffic) -> EventFrequency | None:
    """Return the frequency of the events of a user's own recordings; None where nothing was recorded to count.

    Cut-ins: lane changes with a vehicle behind in the new lane, times the share of these that the filters keep.
    Car-following: pairs that begin while the ego is in the picture already, times the share that the filters keep.
    Brakings to a standstill: those that are fitted.

    Args:
        scenario: "car_following", "cut_in" or "hard_brake".
        events: Columns of all its events, before the filters.
        used: Events that the filters keep.
        traffic: Of the recordings.
    """
    if scenario == "hard_brake":
        return braking_frequency(used, traffic.braking_hours, traffic.braking_km, OWN_SOURCE) if used else None
    if scenario == "car_following":
        count, words = int((~events["at_entry"]).sum()), NEW_LEADERS
    else:
        count, words = int(((events["phase"] == "start") & (events["ego"] >= 0)).sum()), CUT_INS_US101.definition
    if count == 0 or used == 0:
        return None
    return EventFrequency(
        count=count,
        hours=traffic.hours,
        km=traffic.km,
        share=used / count,
        share_events=count,
        definition=words,
        source=OWN_SOURCE,
    )
