"""Long drives: two minutes of traffic that one driver drives alone, on a ring of 200 vehicles and on an open road.

    python -m benchmarks.driving.flow.long_drives DATA [DRIVER ...] [--density 60 ...] [--seed 0] [--json FILE]

Ring: 40 vehicles in each of five lanes of US 101, without entries and exits, at several densities; an open road: the
same column of vehicles with nobody ahead of the first. Do speeds drift, do vehicles pile up, collide or leave the road,
and how often do they change lanes when there is no record to begin from? Flow and density stand beside those of the
recordings (`benchmarks.driving.flow.recorded_flow`). DATA is the folder with the tables of US 101 and, if it is there,
of I-80 by Coifman and Li. Prints a table and writes `benchmarks/results/long_drives.json`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from agents import load_driver
from agents.names import RULE_BASED
from benchmarks import RESULTS
from benchmarks.driving.flow.recorded_flow import COIFMAN_FILE, coifman_points, scene_points, summarise_points
from benchmarks.driving.realism import round_numbers, rule_driver
from benchmarks.driving.realism_score import Decide, by_features, by_lanes
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.threads import use_one_thread
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH
from samplers.benchmark.runs import about
from training.data.ngsim_tables import US101_EDGES
from training.data.trajectories import DT
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.behaviour import HARD_BRAKE_ACCELERATION, find_overlaps, sampling_driver
from training.imitation.traffic.recording import stack_scenes
from training.imitation.traffic.replayed_traffic import Traffic, lane_of, step_replay

LANES, ROWS = 5, 40
"""Vehicles are LANES x ROWS = 200."""
DENSITIES = (15.0, 25.0, 35.0, 45.0, 60.0)
"""Vehicles per km and lane on the ring."""
STANDSTILL_GAP, LEAST_HEADWAY = 2.0, 0.5
"""Least gap at the start: at standstill [m], and by speed [s]."""
GAP_SHAPE = 2.0
"""Of the gamma distribution of what gaps have beyond that; its coefficient of variation is then 0.7."""
OPEN_DENSITY = 25.0
"""On the open road at the start."""
SECONDS, SETTLING = 120.0, 60.0
"""Length of a run, and the part of it that flow and speed are not averaged over [s]."""
REACH = 150.0
"""Vehicles this near to the seam of the ring are seen beyond it too [m]; the lidar's range is 100 m."""
NAMES = ("mgail", "mgail2", "mgail3", "mgail4", "mgail5", "idm", "idm+mobil")
STOPPED = 1.0
"""Speed [m/s] below which a vehicle counts as stopped."""


class Moments(NamedTuple):
    """What was counted of 200 vehicles in T ticks; shape (T,) each."""

    speed: NDArray[np.float64]
    """Mean [m/s]."""
    slowest: NDArray[np.float64]
    """Least speed [m/s]."""
    stopped: NDArray[np.float64]
    """Share below `STOPPED`, as the next three."""
    collision: NDArray[np.float64]
    """Overlapping with another that they did not overlap with at the start."""
    off_road: NDArray[np.float64]
    hard_brake: NDArray[np.float64]
    changes: NDArray[np.float64]
    """Number of vehicles in another lane than a tick before."""


def start_column(density: float, rng: np.random.Generator) -> Traffic:
    """Return 200 vehicles in five lanes with uneven gaps: of `LEAST_HEADWAY` and a share of the rest by chance.

    Args:
        density: Vehicles per km and lane.
        rng: Source of places, and of speeds, which differ by up to 1 m/s from `start_speed`.
    """
    vehicles, speed = LANES * ROWS, start_speed(density)
    least = VEHICLE_LENGTH + STANDSTILL_GAP + LEAST_HEADWAY * speed
    gaps = least + (1000.0 / density - least) * ROWS * rng.dirichlet(np.full(ROWS, GAP_SHAPE), LANES)
    along = np.cumsum(gaps, axis=1) - gaps * rng.random((LANES, 1))  # lanes begin at places of their own
    lane, x = np.arange(vehicles) % LANES, along.T.ravel()
    edges = torch.tensor(US101_EDGES[: LANES + 1])
    middle = 0.5 * (edges[1:] + edges[:-1])
    every = torch.ones(1, vehicles, dtype=torch.bool)
    return Traffic(
        x=torch.from_numpy(x[None]).float(),
        y=middle[torch.from_numpy(lane)][None],
        heading=torch.zeros(1, vehicles),
        speed=torch.from_numpy(speed + rng.uniform(-1.0, 1.0, (1, vehicles))).float(),
        length=torch.full((1, vehicles), VEHICLE_LENGTH),
        width=torch.full((1, vehicles), VEHICLE_WIDTH),
        edges=edges[None],
        scene=torch.zeros(1, dtype=torch.long),
        tick=torch.zeros(1, dtype=torch.long),
        vehicle=torch.arange(vehicles)[None],
        there=every,
        driven=every,
    )


def close_ring(traffic: Traffic, length: float) -> Traffic:
    """Return a ring as a road: vehicles near the seam stand beyond its other end too, where they are not driven."""
    x = traffic.x[0]
    first, last = (x < REACH).nonzero()[:, 0], (x >= length - REACH).nonzero()[:, 0]
    copied, moved = torch.cat((first, last)), torch.cat((x[first] + length, x[last] - length))

    def extend(field: Tensor) -> Tensor:
        return torch.cat((field, field[:, copied]), dim=1)

    parts = {name: extend(getattr(traffic, name)) for name in ("y", "heading", "speed", "length", "width", "vehicle")}
    there = extend(traffic.there)
    driven = torch.cat((traffic.driven, torch.zeros_like(there[:, len(x) :])), dim=1)
    return traffic._replace(x=torch.cat((x, moved))[None], there=there, driven=driven, **parts)


class RingTick(NamedTuple):
    """A tick of a drive of n vehicles, before it is made."""

    traffic: Traffic
    """The vehicles, one scene."""
    action: Tensor
    """Their acceleration [m/s^2] and yaw rate [rad/s], shape (1, n, 2)."""
    touching: Tensor
    """Whether the bodies of each two overlap, shape (1, n, n)."""


@torch.inference_mode()
def drive_ticks(start: Traffic, decide: Decide, length: float | None, seconds: float = SECONDS) -> Iterator[RingTick]:
    """Yield the ticks of a drive in which one driver drives all vehicles.

    Args:
        start: The vehicles, one scene.
        decide: Their driver.
        length: Of the ring [m]; None for an open road.
        seconds: Length of the drive [s].
    """
    traffic, memory, own = start, None, start.x.shape[1]
    for _ in range(round(seconds / DT)):
        seen = traffic if length is None else close_ring(traffic, length)
        action, memory = decide(seen, memory)
        touching = find_overlaps(seen, own)
        yield RingTick(traffic, action, torch.zeros(1, own, own).index_add(2, seen.vehicle[0], touching.float()) > 0.0)
        traffic = step_replay(None, traffic, action)
        if length is not None:
            traffic = traffic._replace(x=torch.remainder(traffic.x, length))


@torch.inference_mode()
def drive_long(start: Traffic, decide: Decide, length: float | None, seconds: float = SECONDS) -> Moments:
    """Return what is counted while one driver drives all vehicles; arguments as of `drive_ticks`."""
    rows, overlapping, lane = [], None, lane_of(start.y, start.edges)
    for traffic, action, touching in drive_ticks(start, decide, length, seconds):
        overlapping = touching if overlapping is None else overlapping
        now, (low, high) = lane_of(traffic.y, traffic.edges), (traffic.edges[0, 0], traffic.edges[0, -1])
        counted = (
            traffic.speed < STOPPED,
            (touching & ~overlapping).any(dim=2),
            (traffic.y < low) | (traffic.y > high),
            action[..., 0] <= HARD_BRAKE_ACCELERATION,
        )
        shares = (each.float().mean() for each in counted)
        rows.append([traffic.speed.mean(), traffic.speed.min(), *shares, (now != lane).sum()])
        lane = now
    return Moments(*np.array(rows, dtype=float).T)


def summarise_drive(moments: Moments, density: float | None) -> dict[str, Any]:
    """Return the figures of a drive; with a density [1/km and lane] the flow [1/h and lane] too."""
    settled = round(SETTLING / DT)
    speed, vehicles = float(moments.speed[settled:].mean()), LANES * ROWS
    per_ten = 10.0 / (vehicles * DT)
    half = (len(moments.speed) - settled) // 2
    return {
        **({} if density is None else {"density": density, "flow": 3.6 * density * speed}),
        "speed": speed,
        "speed_drift": float(moments.speed[-half:].mean() - moments.speed[settled : settled + half].mean()),
        "slowest": float(moments.slowest[settled:].min()),
        **{name: float(getattr(moments, name).mean()) for name in ("stopped", "collision", "off_road", "hard_brake")},
        "stopped_at_the_end": float(moments.stopped[-1]),
        "lane_changes_first_10_s": per_ten * float(moments.changes[: round(10.0 / DT)].mean()),
        "lane_changes_settled": per_ten * float(moments.changes[settled:].mean()),
        "mean_speeds": moments.speed[:: round(10.0 / DT)].tolist(),
        "lane_changes": (per_ten * moments.changes.reshape(-1, round(10.0 / DT)).mean(axis=1)).tolist(),
    }


def choose(name: str, seed: int) -> Decide:
    """Return the driver of a name or file, with one sequence of noise."""
    if name == RULE_BASED:
        return by_features(rule_driver)
    driver: Any = load_driver(name)
    if isinstance(driver, LaneChangingDriver):
        return by_lanes(driver)
    return by_features(sampling_driver(driver, torch.Generator().manual_seed(seed)))


def measure_drives(
    drivers: dict[str, Decide], seed: int, seconds: float = SECONDS, densities: Sequence[float] = DENSITIES
) -> dict[str, Any]:
    """Return the figures of every driver on the ring and on the open road."""
    out = {}
    for name, decide in drivers.items():
        ring = [
            summarise_drive(
                drive_long(
                    start_column(density, np.random.default_rng(seed)),
                    decide,
                    1000.0 * ROWS / density,
                    seconds,
                ),
                density,
            )
            for density in densities
        ]
        column = start_column(OPEN_DENSITY, np.random.default_rng(seed))
        out[name] = {"ring": ring, "open_road": summarise_drive(drive_long(column, decide, None, seconds), None)}
        print(name, flush=True)
    return out


def start_speed(density: float) -> float:
    """Return a speed [m/s] at which gaps are 1.5 s and `STANDSTILL_GAP` in the mean, at most 20 m/s."""
    return float(np.clip((1000.0 / density - VEHICLE_LENGTH - STANDSTILL_GAP) / 1.5, 0.0, 20.0))


def format_drives(found: dict[str, Any]) -> str:
    """Return the tables in Markdown."""
    head = ("", "density, 1/km", "speed, m/s", "flow, 1/h", "drift, m/s", "slowest, m/s", "stopped", "collision")
    head += ("off road", "hard brake", "lane changes per 10 s, first 10 s", "from 60 s on")
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for name, row in found["drivers"].items():
        for each in (*row["ring"], row["open_road"]):
            where = f"{each['density']:.0f}" if "density" in each else "open"
            flow = f"{each['flow']:.0f}" if "flow" in each else ""
            cells = [name, where, f"{each['speed']:.1f}", flow, f"{each['speed_drift']:+.2f}", f"{each['slowest']:.1f}"]
            cells += [f"{each[key]:.4f}" for key in ("stopped", "collision", "off_road", "hard_brake")]
            cells += [f"{each[key]:.3f}" for key in ("lane_changes_first_10_s", "lane_changes_settled")]
            lines.append(f"| {' | '.join(cells)} |")
    for name, points in found["recorded"].items():
        lines += [
            f"| {name} | {each['density']:.0f} | {each['speed']:.1f} | {each['flow']:.0f} |" + " |" * (len(head) - 4)
            for each in points
        ]
    return "\n".join(lines)


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables.")],
    drivers: Annotated[list[str] | None, typer.Argument(help="Files or names; all rows if none.")] = None,
    density: Annotated[list[float] | None, typer.Option(help="On the ring [1/km and lane]; all if none.")] = None,
    seed: Annotated[int, typer.Option(help="Of starts and of the drivers' noise.")] = 0,
    result: Annotated[Path, typer.Option("--json", help="File for the result.")] = RESULTS / "long_drives.json",
) -> None:
    """Drive, print the table and write the result."""
    names = drivers or NAMES
    learn, test = load_scenes(Source("data", data))
    recorded = {"US 101": summarise_points(scene_points(stack_scenes([*learn, *test])))}
    if (data / COIFMAN_FILE).is_file():
        recorded["I-80"] = summarise_points(coifman_points(data))
    chosen = {name: choose(name, seed) for name in names}
    found = {"drivers": measure_drives(chosen, seed, densities=density or DENSITIES), "recorded": recorded}
    command = f"python -m benchmarks.driving.flow.long_drives DATA {' '.join(drivers or ())} --seed {seed}"
    command += "".join(f" --density {each:g}" for each in density or ())
    about_run = about(torch=torch.__version__, command=command, seconds=SECONDS)
    result.write_text(json.dumps(round_numbers({**found, "about": about_run}), indent=1) + "\n", encoding="utf-8")
    print(format_drives(found))


if __name__ == "__main__":
    typer.run(main)
