"""First contacts of learned drivers in dense traffic on a ring: who touches whom, how fast, and how hard they brake.

    python -m benchmarks.driving.flow.pile_up [--driver mgail] [--density 60] [--seconds 40] [--seed 0]

For each pair of vehicles the first contact counts. Prints a table: of the vehicle behind and the one ahead some seconds
before, medians of gap and speeds, the deceleration that is needed to reach the speed ahead within the gap, and what
the one behind does.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from agents import load_driver
from benchmarks.driving.flow.long_drives import ROWS, RingTick, drive_ticks, start_column
from benchmarks.driving.realism_score import by_features
from rare_envs.threads import use_one_thread
from rare_envs.traffic.state import VEHICLE_LENGTH
from training.data.trajectories import DT
from training.imitation.evaluation.behaviour import sampling_driver

BEFORE = (0.5, 1.0, 2.0, 3.0)
"""Times before the contact [s]."""
SAME_LANE = 1.6
"""Contacts of vehicles that are this near across [m] are rear-end."""
LEAST_GAP_LEFT = 0.5
"""Gap [m] to which smaller ones are raised in the deceleration that is needed."""


class FirstContact(NamedTuple):
    """The first contact of two vehicles."""

    tick: int
    behind: int
    ahead: int
    across: float
    """Distance across the road [m]."""


def find_first_contacts(ticks: list[RingTick], length: float) -> list[FirstContact]:
    """Return the first contact of each pair that touches, but for those that do so from the start.

    Args:
        ticks: The drive.
        length: Of the ring [m].
    """
    known, found = ticks[0].touching[0], []
    for tick, (traffic, _, touching) in enumerate(ticks):
        for one, other in (touching[0] & ~known).nonzero().tolist():
            if one < other:
                leads = _way_ahead(traffic.x[0, one], traffic.x[0, other], length) > 0.0
                behind, ahead = (one, other) if leads else (other, one)
                found.append(FirstContact(tick, behind, ahead, float((traffic.y[0, one] - traffic.y[0, other]).abs())))
        known = known | touching[0]
    return found


def look_back(
    ticks: list[RingTick], contacts: list[FirstContact], seconds: float, length: float
) -> NDArray[np.float64]:
    """Return gap, speed behind, speed ahead, deceleration needed and acceleration before contacts, shape (n, 5).

    Contacts that come earlier than `seconds` after the start are left out.
    """
    rows = []
    for contact in contacts:
        tick = contact.tick - round(seconds / DT)
        if tick < 0:
            continue
        traffic, action, _ = ticks[tick]
        gap = float(_way_ahead(traffic.x[0, contact.behind], traffic.x[0, contact.ahead], length)) - VEHICLE_LENGTH
        own, other = float(traffic.speed[0, contact.behind]), float(traffic.speed[0, contact.ahead])
        needed = max(own - other, 0.0) ** 2 / (2.0 * max(gap, LEAST_GAP_LEFT))
        rows.append([gap, own, other, needed, float(action[0, contact.behind, 0])])
    return np.array(rows, dtype=float).reshape(-1, 5)


def _way_ahead(behind: torch.Tensor, ahead: torch.Tensor, length: float) -> torch.Tensor:
    """Return the distance along a ring from one place to another [m], from -length/2 to length/2."""
    return torch.remainder(ahead - behind + 0.5 * length, length) - 0.5 * length


@use_one_thread()
def main(
    driver: Annotated[str, typer.Option(help="Name or file of a learned driver.")] = "mgail",
    density: Annotated[float, typer.Option(help="Vehicles per km and lane.")] = 60.0,
    seconds: Annotated[float, typer.Option(help="Length of the drive.")] = 40.0,
    seed: Annotated[int, typer.Option(help="Of starts and of the drivers' noise.")] = 0,
) -> None:
    """Print how the first contacts on a ring come about."""
    decide = by_features(sampling_driver(load_driver(driver), torch.Generator().manual_seed(seed)))
    length = 1000.0 * ROWS / density
    ticks = list(drive_ticks(start_column(density, np.random.default_rng(seed)), decide, length, seconds))
    contacts = find_first_contacts(ticks, length)
    rear = sum(contact.across < SAME_LANE for contact in contacts)
    print(f"{len(contacts)} first contacts, {rear} of them rear-end")
    print("| s before | contacts | gap, m | behind, m/s | ahead, m/s | needed, m/s^2 | acceleration, m/s^2 | hardest |")
    print("|---|---|---|---|---|---|---|---|")
    for before in BEFORE:
        rows = look_back(ticks, contacts, before, length)
        if len(rows):
            median = " | ".join(f"{value:.1f}" for value in np.median(rows, axis=0))
            print(f"| {before} | {len(rows)} | {median} | {rows[:, 4].min():.1f} |")


if __name__ == "__main__":
    typer.run(main)
