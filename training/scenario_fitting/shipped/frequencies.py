"""Frequencies of the events of the shipped bases: counts in recordings, with exposure, definition and source.

The rates of recordings that were picked for lane changes are never used: the shipped scenes of US 101 show 42 changes
per vehicle-hour, the complete recording 11.
"""

from __future__ import annotations

from rare_envs.distributions.fitted import EventFrequency

LANE_CHANGE_COUNTS = (
    "wein2004/lane-change-externality, outputs/tables/02_detection_summary.md: complete NGSIM recordings; lane changes "
    "with a follower in the new lane, stable for 3 s"
)
COIFMAN = "Coifman and Li 2017, I-80, 16:00, every vehicle of one camera"
CIRCLES = "CIRCLES, one instrumented car on I-24, 60 drives of 2021 (doi 10.5281/zenodo.6366761)"
NEW_LEADERS = "a vehicle in the picture gets a new leader, which it follows for 2 s or more"
NEW_LEADERS_I80 = EventFrequency(
    count=153,
    hours=5.98,
    km=169.7,
    share=152 / 153,
    share_events=153,
    definition=NEW_LEADERS,
    source=COIFMAN,
)
NEW_LEADERS_I24 = EventFrequency(
    count=123,
    hours=3.87,
    km=336.8,
    share=98 / 123,
    share_events=123,
    definition="the gap to the vehicle ahead jumps by 6 m or more within 0.3 s and a leader is tracked after it",
    source=f"{CIRCLES}; the 26 drives with radar, which the events come from",
)
CUT_INS_US101 = EventFrequency(
    count=1221,
    hours=112.0,
    km=3900.0,
    share=38 / 46,
    share_events=46,
    definition="a vehicle changes into the lane ahead of another, gaps within the ranges of the scenario",
    source=f"{LANE_CHANGE_COUNTS}; the share with both gaps in range from 46 recorded changes with a follower",
)
CUT_INS_I80 = EventFrequency(
    count=1693,
    hours=122.5,
    km=2860.0,
    share=63 / 77,
    share_events=77,
    definition=CUT_INS_US101.definition,
    source=f"{LANE_CHANGE_COUNTS}; the share with both gaps in range from 77 changes with a follower, at the crossing: "
    f"1.3 s before it fewer of them are within the picture ({COIFMAN})",
)


def braking_frequency(count: int, hours: float, km: float, source: str) -> EventFrequency:
    """Return the frequency of brakings to a standstill.

    Args:
        count: Brakings.
        hours: Time of all vehicles in which one could begin [h].
        km: Their distance in that time [km].
        source: Where they were counted.
    """
    return EventFrequency(
        count=count,
        hours=hours,
        km=km,
        definition="the vehicle ahead brakes by 3 m/s or more, to less than 1 m/s",
        source=source,
    )
