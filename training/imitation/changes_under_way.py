"""A driver that takes up more of the lane changes under way, and keeps off whoever is very near.

    python -m training.imitation.changes_under_way DATA --out mgail4.safetensors [--driver mgail3]
    python -m training.imitation.changes_under_way DATA --waiting --driver mgail4 --out mgail5.safetensors

Nothing is trained. Which changes a driver takes up is a choice between those that it misses and those that nobody was
making. Prints, in the scenes that the drivers learned from, both for several times that it looks ahead and
several distances over the line at which it takes an unseen lane for granted; with `--waiting` for several times within
which who will be at the line is changing, whether the lane is free and seen or not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import typer
from torch import Tensor

from agents import LearnedDriver
from agents.learned.adjacent_lanes import look_aside
from agents.learned.collision_avoidance import CloseRange
from agents.learned.lane_changes import LaneChanges, Waiting
from rare_envs.threads import use_one_thread
from training.command_line import report_errors, run_command
from training.data.trajectories import DT
from training.imitation.datasets import Source, load_scenes
from training.imitation.noise_damping import load_learned_driver, write_derived
from training.imitation.traffic.crossings import find_crossings
from training.imitation.traffic.recording import Recording, stack_scenes
from training.imitation.traffic.replayed_traffic import lane_of, replay_features, start_replay

FORESIGHT, OVER_LINE, KEPT_BRAKING = 2.4, 0.2, 0.75
"""Settings of mgail4: [s], [m], and the share of the braking beyond 2 m/s^2."""
FORESIGHTS, LINES = (1.8, 2.1, 2.4, 2.7), (0.4, 0.2)
"""Of the table."""
WITHIN = (1.5, 1.8, 2.1, 2.4)
"""Of the table of `--waiting` [s]."""
LATER = 3.0
"""Who crosses a line within this time [s] is changing; of who is recorded for as long and does not, it is an alarm."""
LEAST_ACROSS = 0.2
"""Speed across [m/s] from which on a change counts as under way."""


class Moving(NamedTuple):
    """n moments of driven vehicles."""

    features: Tensor
    """Shape (n, 51)."""
    coming: Tensor
    """Side of the crossing within `LATER`, -1 or 1, 0 for none; shape (n,), as the next three."""
    known: Tensor
    """Whether it is recorded for so long."""
    across: Tensor
    """Speed across [m/s], positive to the right."""
    off_road: Tensor
    """Whether there is no lane where it moves."""


class TakenUp(NamedTuple):
    """How a driver tells who is changing lanes."""

    changing: int
    """Moments of people who cross within `LATER` and move across towards it already."""
    share: float
    """Of these, taken for a change."""
    alarms: float
    """Of a thousand other moments, taken for one."""
    off_road: int
    """Moments taken for a change over the edge of the road."""


def collect_moving(recording: Recording) -> Moving:
    """Return all moments of vehicles that could be driven."""
    scenes, ticks, vehicles = recording.x.shape
    coming = torch.zeros(scenes, ticks, vehicles)
    for scene, tick, vehicle, side in zip(*(column.tolist() for column in find_crossings(recording)), strict=True):
        coming[scene, max(tick - round(LATER / DT), 0) : tick, vehicle] = side
    rows = []
    for tick in range(int(recording.ticks.max())):
        scene = (recording.ticks > tick).nonzero()[:, 0]
        traffic = start_replay(recording, scene, torch.full_like(scene, tick))
        m = traffic.drivers
        vehicle, driven = traffic.vehicle[:, :m], traffic.driven[:, :m]
        later = min(tick + round(LATER / DT), ticks - 1)
        there = recording.present[scene, later].gather(1, vehicle) & (recording.ticks[scene] > later)[:, None]
        there &= later == tick + round(LATER / DT)
        across = traffic.speed[:, :m] * torch.sin(traffic.heading[:, :m])
        lane = lane_of(traffic.y, traffic.edges)[:, :m]
        last = (traffic.edges[:, 1:] > traffic.edges[:, :-1]).sum(dim=1, keepdim=True) - 1
        outside = ((across < 0.0) & (lane == 0)) | ((across > 0.0) & (lane == last))
        columns = (replay_features(traffic, m), coming[scene, tick].gather(1, vehicle), there, across, outside)
        rows.append(tuple(column[driven] for column in columns))
    return Moving(*(torch.cat(column) for column in zip(*rows, strict=True)))


def judge_recognition(moving: Moving, changes: LaneChanges) -> TakenUp:
    """Return how often a driver is right about who is changing lanes."""
    found = changes.recognise(moving.features, look_aside(moving.features))
    changing = (moving.coming != 0.0) & (moving.coming * moving.across >= LEAST_ACROSS)
    other = (moving.coming == 0.0) & moving.known
    taken = found == moving.coming
    return TakenUp(
        changing=int(changing.sum()),
        share=float(taken[changing].float().mean()),
        alarms=1e3 * float((found[other] != 0.0).float().mean()),
        off_road=int(((found != 0.0) & moving.off_road).sum()),
    )


def format_recognition(moving: Moving, changes: LaneChanges, foresights: Sequence[float] = FORESIGHTS) -> str:
    """Return the table in Markdown."""
    lines = ["| foresight, s | over the line, m | taken up | alarms per 1,000 | off the road |", "|" + "---|" * 5]
    for foresight in foresights:
        for over_line in LINES:
            row = judge_recognition(moving, replace(changes, foresight=foresight, over_line=over_line))
            cells = f"{row.share:.2f} of {row.changing} | {row.alarms:.1f} | {row.off_road}"
            lines.append(f"| {foresight:g} | {over_line:g} | {cells} |")
    return "\n".join(lines)


def take_up_changes(driver: LearnedDriver, name: str) -> LearnedDriver:
    """Return a driver with the settings of mgail4 and another name.

    Raises:
        ValueError: It has no lane changes.
    """
    if driver.changes is None or driver.avoidance is None:
        raise ValueError(f"Expected a driver that changes lanes at a hazard rate, got {driver.name!r}.")
    return replace(
        driver,
        changes=replace(driver.changes, foresight=FORESIGHT, over_line=OVER_LINE),
        avoidance=replace(driver.avoidance, close=CloseRange()),
        hard_braking=KEPT_BRAKING,
        name=name,
    )


def wait_for_gaps(driver: LearnedDriver, name: str) -> LearnedDriver:
    """Return a driver with the settings of mgail5 and another name.

    Raises:
        ValueError: It has no lane changes.
    """
    if driver.changes is None:
        raise ValueError(f"Expected a driver that changes lanes at a hazard rate, got {driver.name!r}.")
    return replace(driver, changes=replace(driver.changes, waiting=Waiting()), name=name)


def format_waiting(moving: Moving, changes: LaneChanges, within: Sequence[float] = WITHIN) -> str:
    """Return the table of `--waiting` in Markdown; its first row is without."""
    choices: dict[str, Waiting | None] = {"none": None} | {f"{each:g}": Waiting(foresight=each) for each in within}
    lines = ["| within, s | taken up | alarms per 1,000 | off the road |", "|" + "---|" * 4]
    for name, waiting in choices.items():
        row = judge_recognition(moving, replace(changes, waiting=waiting))
        lines.append(f"| {name} | {row.share:.2f} of {row.changing} | {row.alarms:.1f} | {row.off_road} |")
    return "\n".join(lines)


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    out: Annotated[Path, typer.Option(help="File to write, .safetensors.")],
    driver: Annotated[str, typer.Option(help="Name or file of a driver with lane changes.")] = "mgail3",
    waiting: Annotated[bool, typer.Option("--waiting", help="Write one whose changes wait for a gap.")] = False,
) -> None:
    """Print how changes are told from other motion, and write a driver that takes up more of them."""
    with report_errors("changes_under_way"):
        before = load_learned_driver(driver)
        made = (wait_for_gaps if waiting else take_up_changes)(before, out.stem)
        learn, test = (stack_scenes(scenes) for scenes in load_scenes(Source("data", data)))
        assert made.changes is not None
        moving = collect_moving(learn)
        print(format_waiting(moving, made.changes) if waiting else format_recognition(moving, made.changes))
        difference = "changes that wait" if waiting else "changes under way, close range"
        path = write_derived(made, driver, None, difference, "changes_under_way" + " --waiting" * waiting, test, out)
        print(f"Saved {path}.")


if __name__ == "__main__":
    run_command(main)
