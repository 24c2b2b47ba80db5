"""How and where do drivers change lanes, beside the people of the same scenes?

    python -m benchmarks.driving.flow.changes_made DATA [DRIVER ...] [--test] [--json FILE]

DATA is the folder with the tables of US 101; drivers are files or the names of shipped ones. All vehicles are driven
for 20 s from every 2 s of every scene, all scenes or with `--test` those that nobody learned from. A change counts if
the vehicle is in one lane for a second on either side. It begins and ends where the speed across, over half a second,
is 0.2 m/s or less; quantities of traffic are of the moment at which it begins, from where everybody is, not from a
lidar. Two more questions: how many of the changes that are under way in the record, from the moment at which they begin
to the crossing, does a driver complete? And how far are the distributions of drivers and people apart (Kolmogorov and
Smirnov's distance, with the chance of a greater one if both are alike)? Writes `benchmarks/results/changes_made.json`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from scipy.stats import ks_2samp
from torch import Tensor

from benchmarks import RESULTS
from benchmarks.driving.lane_changes import find_completed
from benchmarks.driving.realism import load_named, round_numbers
from rare_envs.threads import use_one_thread
from samplers.benchmark.runs import about
from samplers.problem import FloatArray
from training.data.lane_change_courses import LATERAL_SPAN, LATERAL_SPEED, time_between_spans
from training.data.trajectories import DT
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.behaviour import Act, drive_traffic, regular_starts, sampling_driver
from training.imitation.traffic.crossings import Crossings, find_crossings
from training.imitation.traffic.recording import Recording, stack_scenes
from training.imitation.traffic.replayed_traffic import lane_of, start_replay

SECONDS = 20.0
"""Length of a drive."""
DRAWS = 1000
"""Of the bootstrap over changes."""
QUANTITIES = ("duration", "speed", "gap ahead", "new gap ahead", "new gap behind", "speed of the new lane")
"""Of a change: its duration [s], and at its beginning the own speed [m/s], gaps to the nearest ahead in the old and in
the new lane and to the nearest behind there [m], and how much faster [m/s] the nearest there drives."""


def drive_as_recording(recording: Recording, act: Act, seconds: float = SECONDS) -> Recording:
    """Return drives from every 2 s of every scene as a recording; `acts` is True for who is driven."""
    scene, tick = regular_starts(recording)
    columns: dict[str, list[Tensor]] = {name: [] for name in ("x", "y", "heading", "speed")}
    actions = []
    with torch.inference_mode():
        for moment in drive_traffic(recording, start_replay(recording, scene, tick), act, round(seconds / DT)):
            traffic = moment.traffic
            for name, rows in columns.items():
                rows.append(getattr(traffic, name))  # a field by its name
            rest = traffic.x.shape[1] - moment.action.shape[1]
            actions.append(torch.nn.functional.pad(moment.action, (0, 0, 0, rest)))
    motion = {name: torch.stack(rows, dim=1) for name, rows in columns.items()}
    action = torch.stack(actions, dim=1)
    shape = motion["x"].shape
    return Recording(
        **motion,
        acceleration=action[..., 0],
        yaw_rate=action[..., 1],
        present=traffic.there[:, None].expand(shape),
        acts=traffic.driven[:, None].expand(shape),
        length=traffic.length,
        width=traffic.width,
        edges=traffic.edges,
        ticks=torch.full((shape[0],), shape[1]),
    )


def find_beginning(recording: Recording, scene: int, tick: int, vehicle: int, side: int) -> int | None:
    """Return the tick at which the change begins that crosses at one; None if it began before the vehicle was there."""
    y, there = recording.y[scene, :, vehicle], recording.present[scene, :, vehicle]
    slow = LATERAL_SPEED * LATERAL_SPAN * DT
    while tick >= LATERAL_SPAN and bool(there[tick - LATERAL_SPAN]):
        if side * float(y[tick] - y[tick - LATERAL_SPAN]) <= slow:
            return tick
        tick -= 1
    return None


def find_end(recording: Recording, scene: int, tick: int, vehicle: int, side: int) -> int | None:
    """Return the tick at which it ends; None if the vehicle is gone before."""
    y, there = recording.y[scene, :, vehicle], recording.present[scene, :, vehicle]
    slow = LATERAL_SPEED * LATERAL_SPAN * DT
    while tick + LATERAL_SPAN < int(recording.ticks[scene]) and bool(there[tick + LATERAL_SPAN]):
        if side * float(y[tick + LATERAL_SPAN] - y[tick]) <= slow:
            return tick
        tick += 1
    return None


def describe_beginning(recording: Recording, scene: int, tick: int, vehicle: int, side: int) -> list[float]:
    """Return `QUANTITIES` from the second on, infinite or NaN where nobody is there."""
    there = recording.present[scene, tick].clone()
    there[vehicle] = False
    x, speed = recording.x[scene, tick], recording.speed[scene, tick]
    lane = lane_of(recording.y[scene, tick][None], recording.edges[scene][None])[0]
    gaps = (x - x[vehicle]).abs() - 0.5 * (recording.length[scene] + recording.length[scene, vehicle])
    ahead, new = x >= x[vehicle], lane == lane[vehicle] + side
    found = [float(speed[vehicle])]
    for among in (ahead & (lane == lane[vehicle]), ahead & new, ~ahead & new):
        found.append(float(torch.where(among & there, gaps, torch.inf).min()))
    nearest = torch.where(new & there, gaps, torch.inf).min(dim=0)
    faster = float(speed[nearest.indices] - speed[vehicle]) if nearest.values < torch.inf else float("nan")
    return [*found, faster]


def describe_changes(recording: Recording) -> dict[str, FloatArray]:
    """Return `QUANTITIES`, side and lane of the n changes of those who act, shape (n,) each, NaN where unknown."""
    rows = []
    for scene, tick, vehicle, side in zip(*(column.tolist() for column in find_crossings(recording)), strict=True):
        if not bool(recording.acts[scene, tick, vehicle]):
            continue
        where = (scene, tick, vehicle, side)
        begun, end = find_beginning(recording, *where), find_end(recording, *where)
        lane = int(lane_of(recording.y[scene, tick - 1][None], recording.edges[scene][None])[0, vehicle])
        duration, moment = float("nan"), [float("nan")] * (len(QUANTITIES) - 1)
        if begun is not None:
            moment = describe_beginning(recording, scene, begun, vehicle, side)
            if end is not None:
                duration = float(time_between_spans(np.array([begun]), np.array([end]), DT)[0])
        rows.append([duration, *moment, side, lane])
    columns = np.array(rows, dtype=float).reshape(-1, len(QUANTITIES) + 2).T
    return dict(zip((*QUANTITIES, "side", "lane"), columns, strict=True))


def exposure(recording: Recording) -> float:
    """Return the vehicle-time of those who act, in 10 s."""
    return float(recording.acts.sum()) * DT / 10.0


def summarise_changes(
    changes: dict[str, FloatArray], tens: float, people: dict[str, FloatArray] | None
) -> dict[str, Any]:
    """Return rates, shares and quartiles, and distances from people.

    Args:
        changes: As `describe_changes` returns them.
        tens: Vehicle-time [10 s].
        people: Those of people; None for people.
    """
    out: dict[str, Any] = {
        "changes": len(changes["side"]),
        "per_10_s": len(changes["side"]) / tens,
        "to_the_left": float((changes["side"] < 0).mean()) if len(changes["side"]) else float("nan"),
    }
    for name in QUANTITIES:
        values = changes[name][~np.isnan(changes[name])]
        out[name] = {"known": len(values)}
        if len(values):
            out[name]["quartiles"] = np.quantile(values, [0.25, 0.5, 0.75], method="nearest").tolist()
        if people is not None and len(values):
            theirs = people[name][~np.isnan(people[name])]
            test = ks_2samp(values, theirs)
            out[name] |= {"distance": float(test.statistic), "chance": float(test.pvalue)}
    return out


def under_way(recording: Recording) -> dict[float, Crossings]:
    """Return the crossings whose change is under way some time before, by that time [s]: every 0.5 s up to 3 s."""
    crossings = find_crossings(recording)
    begun = [
        find_beginning(recording, *where) for where in zip(*(column.tolist() for column in crossings), strict=True)
    ]
    out = {}
    for ticks in range(2, 31, 4):
        chosen = [
            (start is None or start <= tick - ticks) and tick >= ticks
            for start, tick in zip(begun, crossings.tick.tolist(), strict=True)
        ]
        out[ticks * DT] = Crossings(*(column[torch.tensor(chosen, dtype=torch.bool)] for column in crossings))
    return out


def share_completed(recording: Recording, acts: list[Act]) -> dict[str, Any]:
    """Return how many of the moments at which a change is under way a driver takes to its end.

    Args:
        recording: Scenes.
        acts: One driver for each sequence of noise.

    Returns:
        The number of changes and of their moments, the share, and its 95 % interval by bootstrap over changes.
    """
    counts: dict[tuple[int, ...], list[int]] = {}  # of each change: moments, and those completed
    for seconds, crossings in under_way(recording).items():
        if not len(crossings.tick):
            continue
        for act in acts:
            changes, crossed = find_completed(recording, crossings, act, seconds)
            for *which, done in zip(*(column.tolist() for column in (*changes, crossed)), strict=True):
                count = counts.setdefault(tuple(which), [0, 0])
                count[0], count[1] = count[0] + 1, count[1] + done
    moments, completed = np.array(list(counts.values()), dtype=float).reshape(-1, 2).T
    share = {"changes": len(moments), "moments": moments.sum() / max(len(acts), 1)}
    if not len(moments):
        return share | {"completed": 0.0}
    times = np.random.default_rng(0).multinomial(len(moments), np.full(len(moments), 1.0 / len(moments)), DRAWS)
    interval = np.quantile((times @ completed) / (times @ moments), [0.025, 0.975])
    return share | {"completed": completed.sum() / moments.sum(), "interval": interval.tolist()}


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    drivers: Annotated[list[str] | None, typer.Argument(help="Files or shipped names.")] = None,
    in_test: Annotated[bool, typer.Option("--test", help="Only the scenes that nobody learned from.")] = False,
    result: Annotated[Path, typer.Option("--json", help="File for the result.")] = RESULTS / "changes_made.json",
) -> None:
    """Measure, print and write."""
    learn, test = load_scenes(Source("data", data))
    scenes = stack_scenes(test if in_test else [*learn, *test])
    people = describe_changes(scenes)
    found = {"people": summarise_changes(people, exposure(scenes), None)}
    for name, driver in load_named(drivers or ["mgail", "mgail2", "mgail3", "mgail4", "mgail5"]).items():
        made = drive_as_recording(scenes, sampling_driver(driver, torch.Generator().manual_seed(0)))
        found[name] = summarise_changes(describe_changes(made), exposure(made), people)
        acts = [sampling_driver(driver, torch.Generator().manual_seed(seed)) for seed in range(3)]
        found[name]["under_way"] = share_completed(scenes, acts)
        print(name, json.dumps(round_numbers(found[name])), flush=True)
    about_run = about(
        torch=torch.__version__, command="python -m benchmarks.driving.flow.changes_made DATA" + " --test" * in_test
    )
    result.write_text(json.dumps(round_numbers({**found, "about": about_run}), indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
