"""Do drivers finish the lane changes that people have begun? Why learned drivers change lanes so rarely.

    python -m benchmarks.driving.lane_changes DATA [DRIVER ...]

DATA is the folder with the tables of US 101; drivers are files or the names of shipped ones. Writes
`benchmarks/results/lane_changes.json`. Two questions:

- *Under way.* Every lane change in the record is taken up some time before the crossing, all vehicles driven by the
  driver: how many of these vehicles cross in that time and 2 s more? Of the people all do.
- *Steering.* What yaw rate is there on average, by how fast a vehicle moves across its lane and on which side of the
  middle it is: in the record, and of the driver's mean actions in the same moments? Towards where it moves is positive.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from agents import LearnedDriver
from benchmarks import RESULTS
from benchmarks.driving.realism import load_named, round_numbers
from rare_envs.sensors.perception import FEATURES, HEADING_COLUMN, SPEED_COLUMN
from rare_envs.threads import use_one_thread
from samplers.benchmark.runs import about
from training.data.trajectories import DT
from training.imitation.algorithms.expert_pairs import Pairs, collect_pairs
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.behaviour import Act, drive_traffic, sampling_driver
from training.imitation.traffic.crossings import Crossings, find_crossings
from training.imitation.traffic.recording import Recording, stack_scenes
from training.imitation.traffic.replayed_traffic import lane_of, start_replay

BEFORE = (0.5, 1.0, 1.5, 2.0, 3.0)
"""Seconds before the crossing at which drivers take over."""
AFTER = 2.0
"""Seconds beyond that in which they may still cross."""
OFFSET = FEATURES.index("lane_offset")
CLASSES = {
    "keeps its lane: less than 0.2 m/s across": (0.0, 0.2, -np.inf, np.inf),
    "0.2 to 0.4 m/s across": (0.2, 0.4, -np.inf, np.inf),
    "moves out: 0.6 m/s or more, beyond the middle": (0.6, np.inf, 0.0, np.inf),
    "comes in: 0.6 m/s or more, 0.5 m or more before the middle": (0.6, np.inf, -np.inf, -0.5),
}
"""Moments by speed across [m/s] and offset from the middle [m], both towards where the vehicle moves."""


def find_completed(
    recording: Recording, crossings: Crossings, act: Act, seconds: float
) -> tuple[Crossings, torch.Tensor]:
    """Return the changes recorded and driven that long before the crossing, and whether the driver completes them."""
    lead = round(seconds / DT)
    crossings = Crossings(*(column[crossings.tick >= lead] for column in crossings))
    scene, tick, vehicle, side = crossings
    traffic = start_replay(recording, scene, tick - lead)
    chosen = traffic.driven & (traffic.vehicle == vehicle[:, None])
    rows = chosen.any(dim=1)  # the others have nobody ahead in their lane, and are replayed
    traffic = type(traffic)(*(field[rows] for field in traffic))
    row, at = torch.arange(int(rows.sum())), chosen[rows].int().argmax(dim=1)
    first = lane_of(traffic.y, traffic.edges)[row, at]
    crossed = torch.zeros(len(row), dtype=torch.bool)
    with torch.inference_mode():
        for moment in drive_traffic(recording, traffic, act, lead + round(AFTER / DT)):
            now = lane_of(moment.traffic.y, moment.traffic.edges)[row, at]
            crossed |= (now - first) * side[rows] > 0
    return Crossings(*(column[rows] for column in crossings)), crossed


def count_completed(recording: Recording, crossings: Crossings, act: Act, seconds: float) -> tuple[int, float]:
    """Return the number of changes recorded that long before the crossing, and the share that the driver completes."""
    _, crossed = find_completed(recording, crossings, act, seconds)
    return len(crossed), float(crossed.float().mean())


def measure_steering(pairs: Pairs, drivers: dict[str, LearnedDriver]) -> dict[str, dict[str, float]]:
    """Return mean yaw rates [rad/s] in the direction of motion, by `CLASSES`, of people and of drivers' means."""
    heading = pairs.features[:, HEADING_COLUMN]
    side = heading.sign()
    across, offset = heading.abs() * pairs.features[:, SPEED_COLUMN], pairs.features[:, OFFSET] * side
    with torch.inference_mode():
        made = {name: driver.act(pairs.features[:, None])[0][:, 0, 1] for name, driver in drivers.items()}
    out = {}
    for name, (slow, fast, left, right) in CLASSES.items():
        inside = (across >= slow) & (across < fast) & (offset >= left) & (offset < right)
        rates = {"people": pairs.action[:, 1], **made}
        out[name] = {"moments": int(inside.sum())} | {
            who: float((rate * side)[inside].mean()) for who, rate in rates.items()
        }
    return out


def measure_changes(recording: Recording, drivers: dict[str, LearnedDriver], noises: int) -> dict[str, Any]:
    """Return the answers to both questions, ready for JSON."""
    crossings = find_crossings(recording)
    under_way: dict[str, dict[str, float]] = {}
    for seconds in BEFORE:
        row: dict[str, float] = {}
        for name, driver in drivers.items():
            runs = [
                count_completed(
                    recording, crossings, sampling_driver(driver, torch.Generator().manual_seed(seed)), seconds
                )
                for seed in range(noises)
            ]
            row["changes"], row[name] = runs[0][0], float(np.mean([share for _, share in runs]))
        under_way[f"{seconds:g} s before"] = row
    return {
        "crossings": len(crossings.scene),
        "under_way": under_way,
        "steering": measure_steering(collect_pairs(recording), drivers),
    }


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    drivers: Annotated[list[str] | None, typer.Argument(help="Files or shipped names.")] = None,
    noises: Annotated[int, typer.Option(help="Sequences of noise of each driver.")] = 5,
    out: Annotated[Path, typer.Option("--json", help="File for the result.")] = RESULTS / "lane_changes.json",
) -> None:
    """Measure on all scenes, those that the drivers learned from included: changes are few."""
    learn, test = load_scenes(Source("data", data))
    found = round_numbers(
        measure_changes(stack_scenes([*learn, *test]), load_named(drivers or ["mgail", "gail", "bc"]), noises)
    )
    print(json.dumps(found, indent=1))
    out.write_text(json.dumps({"about": about(torch=torch.__version__), **found}, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
