"""A simulator of its own, in a process of its own: one JSON object a line in, one a line out. It needs Python alone.

In:  {"id": 7, "x": {"ego_speed": 20.0, "lead_speed": 15.0, "gap": 30.0}}
Out: {"id": 7, "f": 1.52}

The lead brakes with 6 m/s^2 to a standstill. The ego reacts after 0.6 s and brakes with 8 m/s^2.
f is the least gap [m], and 0 or less a collision: replace `simulate` by a call of your simulator.
"""

import json
import sys

REACTION_TIME, EGO_BRAKING, LEAD_BRAKING, TICK = 0.6, 8.0, 6.0, 0.02


def simulate(ego_speed: float, lead_speed: float, gap: float) -> float:
    """Return the least gap of a drive [m]; after a collision how fast the ego was then, times -1 [m/s]."""
    time, least = 0.0, gap
    while ego_speed > 0.0:
        gap += (lead_speed - ego_speed) * TICK
        least = min(least, gap)
        if gap <= 0.0:
            return -(ego_speed - lead_speed)
        lead_speed = max(0.0, lead_speed - LEAD_BRAKING * TICK)
        time += TICK
        if time > REACTION_TIME:
            ego_speed = max(0.0, ego_speed - EGO_BRAKING * TICK)
    return least


def main() -> None:
    """Answer until the input ends."""
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps({"id": request["id"], "f": simulate(**request["x"])}), flush=True)


if __name__ == "__main__":
    main()
