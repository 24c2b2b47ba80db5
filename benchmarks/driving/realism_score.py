"""How likely do drivers make the recorded future? The realism score of the Waymo Open Sim Agents Challenge on US 101.

    python -m benchmarks.driving.realism_score DATA [DRIVER ...] [--seed 0] [--json FILE]

DATA is the folder with the tables of US 101. Every 2 s of the seven test scenes, where 4 s or more of the record are
left, all vehicles but the first of each lane are driven for up to 8 s, 32 times, and the record is scored under these
rollouts (`benchmarks.driving.sim_agents`). Prints a table and writes
`benchmarks/results/realism_score.json`.

*The record itself*, 32 copies, is the most that any driver can reach whose rollouts are all alike.

What differs from the challenge: a straight motorway of 100 to 300 m, vehicles only, smoothed positions, a history of
one step, agents are scored until they leave the window, and steps of rollouts count only where the record has them.
Scores are means over the starts of a scene, then over scenes; standard errors are over the seven scenes, which share
vehicles.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from torch import Tensor

from agents import LearnedDriver, load_driver
from benchmarks import RESULTS, format_table
from benchmarks.driving.realism import constant_velocity, round_numbers, rule_driver
from benchmarks.driving.sim_agents import MOTORWAY, SCENE_ROLLOUTS, WOSAC_2024, motion_features, score_features
from benchmarks.samplers.runs import about
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.startup import use_one_thread
from rare_envs.traffic.bodies import LaneTraffic
from training.data.table import DT
from training.imitation.evaluate import Act, regular_starts, sampling_driver
from training.imitation.traffic import (
    Recording,
    Traffic,
    lane_of,
    replay_features,
    stack_scenes,
    start_replay,
    step_replay,
)
from training.imitation.train import Source, load_scenes

TICKS = 80
"""Ticks of a rollout: 8 s, as in the challenge."""
LEAST_TICKS = 40
"""Ticks of record that a start needs."""
BASELINE = "idm"
"""Row that the others are compared with, scene by scene."""
LEARNED = ("gail", "mgail")
SETTINGS = {"wosac_2024": WOSAC_2024, "motorway": MOTORWAY}

Decide = Callable[[Traffic, "Tensor | None"], tuple[Tensor, "Tensor | None"]]
"""Function from traffic and a memory, None at first, to actions of the driven vehicles (B, M, 2) and the new memory."""


class Start(NamedTuple):
    """One start: what is recorded from it on."""

    scene: Tensor
    """Scene and tick, shape (1,) each."""
    tick: Tensor
    states: Tensor
    """Recorded poses of the V vehicles that are there, for `TICKS` or to the end of the scene, shape (V, T + 1, 3)."""
    valid: Tensor
    """Where they are recorded, shape (V, T + 1)."""
    traffic: Traffic
    """The same vehicles at the start, one scene."""


def find_starts(recording: Recording) -> Iterator[Start]:
    """Yield a start every 2 s of each scene where `LEAST_TICKS` of the record are left."""
    for scene, tick in zip(*regular_starts(recording), strict=True):
        if int(recording.ticks[scene] - tick) < LEAST_TICKS:
            continue
        traffic = start_replay(recording, scene[None], tick[None])
        at = torch.arange(int(tick), min(int(tick) + TICKS + 1, int(recording.ticks[scene])))
        vehicle = traffic.vehicle[0]
        fields = (recording.x, recording.y, recording.heading)
        states = torch.stack([field[scene, at][:, vehicle].T for field in fields], dim=-1)
        valid = recording.present[scene, at][:, vehicle].T & traffic.there[0][:, None]
        # a vehicle that comes back after a hole is another one to the simulation
        yield Start(scene[None], tick[None], states, valid.cumprod(dim=1).bool(), traffic)


def simulate(recording: Recording, start: Start, decide: Decide, rollouts: int) -> Tensor:
    """Return the poses of rollouts from a start, shape (R, V, T + 1, 3)."""
    traffic = start_replay(recording, start.scene.expand(rollouts), start.tick.expand(rollouts))
    m, memory, rows = traffic.drivers, None, []
    unused = torch.zeros(rollouts, traffic.x.shape[1] - m, 2)
    for _ in range(start.states.shape[1]):
        rows.append(torch.stack((traffic.x, traffic.y, traffic.heading), dim=-1))
        action, memory = decide(traffic, memory)
        traffic = step_replay(recording, traffic, torch.cat((action, unused), dim=1))
    return torch.stack(rows, dim=2)


def by_features(act: Act) -> Decide:
    """Return a driver that acts by lidar features."""
    return lambda traffic, memory: act(replay_features(traffic, traffic.drivers), memory)


def by_lanes(driver: LaneChangingDriver) -> Decide:
    """Return IDM + MOBIL."""

    def decide(traffic: Traffic, memory: Tensor | None) -> tuple[Tensor, Tensor]:
        m = traffic.drivers
        if memory is None:
            memory = driver.begin(torch.zeros(len(traffic.x), m, 2, 2))
        x, y, heading, speed, length, width, edges = traffic[:7]
        return driver.decide(LaneTraffic(x, y, heading, speed, length, width, edges), slice(0, m), memory, DT)

    return decide


def judge(start: Start, rollouts: Tensor, copies: int = 1) -> dict[str, Any]:
    """Return the scores of rollouts of a start, and how many vehicles collide, leave the road and change lanes."""
    traffic = start.traffic
    edges = (float(traffic.edges[0, 0]), float(traffic.edges[0, -1]))
    sizes, driven = torch.stack((traffic.length[0], traffic.width[0]), dim=-1), traffic.driven[0]
    future = start.valid[driven].clone()
    future[:, 0] = False  # the start is the record's
    simulated, real = (
        motion_features(states, start.valid, sizes, edges, driven) for states in (rollouts, start.states)
    )
    error = torch.hypot(*(rollouts - start.states)[:, driven, :, :2].movedim(-1, 0))
    min_ade = float((error * future).sum(dim=(1, 2)).min() / future.sum())
    scores = {name: score_features(simulated, real, future, one, min_ade, copies) for name, one in SETTINGS.items()}
    events = {name: ((simulated[f"{name}_indication"] > 0) & future).any(dim=-1) for name in ("collision", "offroad")}
    y = rollouts[:, driven, :, 1]
    lane = lane_of(y.flatten(1), traffic.edges.expand(len(y), -1)).view(y.shape)
    both = future[:, 1:] & start.valid[driven][:, :-1]
    changes = ((lane[..., 1:] != lane[..., :-1]) & both).double().sum() / len(y)
    return {
        **{name: asdict(score) for name, score in scores.items()},
        **{name: float(event.double().mean()) for name, event in events.items()},
        "changes": float(changes),
        "vehicle_seconds": float(both.sum()) * DT,
        "scene": int(start.scene),
    }


def average_scenes(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means over starts, then over scenes, with standard errors over scenes; scores by scene too."""
    scenes = sorted({row["scene"] for row in rows})

    def of(value: Callable[[dict[str, Any]], float], each: bool = False) -> dict[str, Any]:
        means = [np.mean([value(row) for row in rows if row["scene"] == scene]) for scene in scenes]
        error = np.std(means, ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
        averages = {"mean": float(np.mean(means)), "standard_error": float(error)}
        return averages | ({"scenes": [float(mean) for mean in means]} if each else {})

    out: dict[str, Any] = {}
    for name in SETTINGS:
        first = rows[0][name]
        out[name] = {
            "meta": of(lambda row, n=name: row[n]["meta"], each=True),
            "min_ade": of(lambda row, n=name: row[n]["min_ade"]),
        }
        for part in ("buckets", "likelihoods"):
            out[name][part] = {key: of(lambda row, n=name, p=part, k=key: row[n][p][k]) for key in first[part]}
    out |= {name: of(lambda row, n=name: row[n]) for name in ("collision", "offroad")}
    seconds = sum(row["vehicle_seconds"] for row in rows)
    out["lane_changes_per_10_s"] = 10.0 * sum(row["changes"] for row in rows) / seconds
    return out


def measure_scores(
    test: Recording,
    drivers: dict[str, LearnedDriver],
    seed: int = 0,
    rollouts: int = SCENE_ROLLOUTS,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, dict[str, Any]]:
    """Return the averages of every row by its name; each start of each driver has noise of its own from the seed."""
    starts = list(find_starts(test))

    def generator(row: int, start: int) -> torch.Generator:
        return torch.Generator().manual_seed(1_000_000 * seed + 1_000 * row + start)

    def alike(decide: Decide) -> Callable[[int, Start], Tensor]:
        return lambda k, start: simulate(test, start, decide, 1)

    rows: dict[str, Callable[[int, Start], Tensor]] = {
        "the record itself": lambda k, start: start.states[None],
        "constant velocity": alike(by_features(constant_velocity)),
        "idm": alike(by_features(rule_driver)),
        "idm+mobil": alike(by_lanes(LaneChangingDriver())),
    }
    for row, (name, driver) in enumerate(drivers.items(), start=1):
        rows[name] = lambda k, start, d=driver, r=row: simulate(
            test, start, by_features(sampling_driver(d, generator(r, k))), rollouts
        )
    out = {}
    for name, roll in rows.items():
        with torch.inference_mode():
            poses = ((start, roll(k, start)) for k, start in enumerate(starts))  # one stands for all that are alike
            judged = [judge(start, each, rollouts // len(each)) for start, each in poses]
        out[name] = average_scenes(judged)
        say(name)
    out["the record itself"]["starts"] = len(starts)
    return out


def format_scores(found: dict[str, dict[str, Any]]) -> str:
    """Return the scores as a table in Markdown; errors are standard errors over scenes, of differences over pairs."""
    names = ("score", f"less {BASELINE}'s", "kinematic", "interactive", "map", "motorway bins", "min ADE, m")
    names += ("collide", "off road", "lane changes per 10 s")

    def shown(value: dict[str, Any], digits: int = 3) -> str:
        return f"{value['mean']:.{digits}f} ± {value['standard_error']:.{digits}f}"

    lines = []
    for name, row in found.items():
        published = row["wosac_2024"]
        apart = np.subtract(published["meta"]["scenes"], found[BASELINE]["wosac_2024"]["meta"]["scenes"])
        difference = {"mean": apart.mean(), "standard_error": apart.std(ddof=1) / np.sqrt(len(apart))}
        cells = [shown(published["meta"]), "" if name == BASELINE else shown(difference)]
        cells += [*(shown(bucket) for bucket in published["buckets"].values())]
        cells += [shown(row["motorway"]["meta"]), shown(published["min_ade"], 2)]
        cells += [f"{row['collision']['mean']:.3f}", f"{row['offroad']['mean']:.3f}"]
        lines.append([name, *cells, f"{row['lane_changes_per_10_s']:.3f}"])
    return format_table(["", *names], lines)


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    names: Annotated[list[str] | None, typer.Argument(help="Files or shipped names; all shipped ones if none.")] = None,
    seed: Annotated[int, typer.Option(help="Of the drivers' noise and of the resampling.")] = 0,
    rollouts: Annotated[int, typer.Option(help="Of each start.")] = SCENE_ROLLOUTS,
    result: Annotated[Path, typer.Option("--json", help="File for the result.")] = RESULTS / "realism_score.json",
) -> None:
    """Score drivers, print the table and write the result."""
    begun = time.process_time()
    test = stack_scenes(load_scenes(Source("data", data))[1])
    drivers: dict[str, Any] = {name: load_driver(name) for name in names or LEARNED}
    found = measure_scores(
        test,
        drivers,
        seed,
        rollouts,
        lambda name: print(f"{time.process_time() - begun:5.0f} s  {name}", flush=True),
    )
    settings = {"seed": seed, "rollouts": rollouts, "ticks": TICKS}
    command = (
        f"python -m benchmarks.driving.realism_score DATA {' '.join(names or ())} --seed {seed} --rollouts {rollouts}"
    )
    bins = {name: {feature: list(each) for feature, each in setting.items()} for name, setting in SETTINGS.items()}
    about_run = about(torch=torch.__version__, command=command, **settings, seconds=round(time.process_time() - begun))
    text = json.dumps(round_numbers({"rows": found, "settings": bins, "about": about_run}), indent=1)
    result.write_text(text + "\n", encoding="utf-8")
    print(format_scores(found))


if __name__ == "__main__":
    typer.run(main)
