"""Touching pairs: vehicles that collide in the test scenes when one driver drives all of them.

    python -m training.imitation.touching_pairs DATA [--driver mgail] [--seconds 20] [--seed 0]

Starts are those of the realism figures, every 2 s of every scene. Prints the pairs that touch and did not at the start,
longest first: their scene and start, when they touch first and for how many vehicle-steps of driven ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import typer

from rare_envs.threads import use_one_thread
from training.command_line import report_errors, run_command
from training.data.trajectories import DT
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.behaviour import (
    DrivingStep,
    drive_traffic,
    find_overlaps,
    regular_starts,
    sampling_driver,
)
from training.imitation.noise_damping import load_learned_driver
from training.imitation.traffic.recording import stack_scenes
from training.imitation.traffic.replayed_traffic import start_replay


@dataclass
class TouchingPair:
    """Two vehicles of one start that touch."""

    scene: int
    start: int
    """Tick of the scene at which the drive begins."""
    replayed: bool
    """Whether one of the two is replayed."""
    first: int
    """Tick of the drive at which they touch first, as the next two."""
    along: float
    """Distance along the road [m]."""
    across: float
    """Distance across it [m]."""
    steps: int = 0
    """Number of vehicle-steps of driven vehicles in contact."""


@torch.inference_mode()
def find_touching_pairs(moments: Iterator[DrivingStep]) -> list[TouchingPair]:
    """Return the pairs that touch in a drive, longest first; those that touch at its start are left out."""
    found: dict[tuple[int, int, int], TouchingPair] = {}
    known = start = torch.zeros(0)
    for tick, moment in enumerate(moments):
        traffic, m = moment.traffic, moment.action.shape[1]
        touching = find_overlaps(traffic, m) & traffic.driven[:, :m, None]
        if tick == 0:
            known, start = touching, traffic.tick
        for row, one, other in (touching & ~known).nonzero().tolist():
            key = row, min(one, other), max(one, other)
            if key not in found:
                along, across = ((field[row, one] - field[row, other]).abs() for field in (traffic.x, traffic.y))
                replayed, scene = not bool(traffic.driven[row, other]), int(traffic.scene[row])
                found[key] = TouchingPair(scene, int(start[row]), replayed, tick, float(along), float(across))
            found[key].steps += 1
    return sorted(found.values(), key=lambda pair: -pair.steps)


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    driver: Annotated[str, typer.Option(help="Name or file of a learned driver.")] = "mgail",
    seconds: Annotated[float, typer.Option(help="Length of the drives.")] = 20.0,
    seed: Annotated[int, typer.Option(help="Of the driver's noise.")] = 0,
) -> None:
    """Print which vehicles collide in the test scenes."""
    with report_errors("touching_pairs"):
        chosen = load_learned_driver(driver)
        test = stack_scenes(load_scenes(Source("data", data))[1])
    traffic = start_replay(test, *regular_starts(test))
    ticks = round(seconds / DT)
    act = sampling_driver(chosen, torch.Generator().manual_seed(seed))
    pairs = find_touching_pairs(drive_traffic(test, traffic, act, ticks))
    total = int(traffic.driven.sum()) * ticks
    steps = sum(pair.steps for pair in pairs)
    print(f"{len(pairs)} pairs, {steps:,} of {total:,} vehicle-steps ({steps / total:.4f})")
    print("| scene | start, s | touch first, s | along, m | across, m | one is replayed | vehicle-steps |")
    print("|" + "---|" * 7)
    for pair in pairs:
        cells = [str(pair.scene), f"{pair.start * DT:.0f}", f"{pair.first * DT:.1f}", f"{pair.along:.1f}"]
        cells += [f"{pair.across:.1f}", "yes" if pair.replayed else "", str(pair.steps)]
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    run_command(main)
