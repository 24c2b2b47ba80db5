"""The ego `imitation`: a driver learned from recorded people and encounters, corrected where it failed.

    python -m training.recipes.imitation --data TABLES --out runs/imitation

It is trained as the drivers of the traffic are (`training.imitation`): likelihood and critic use recorded people only,
and the gradient goes through the simulator. Two things differ. Beside recorded scenes it drives encounters: draws of
this project's scenarios, which the others replay, many behind each other on one road. And its loss has penalties on
following closely, leaving the middle of the lane and speeding.

Then it is corrected (`ordinary_traffic.learn`): it drives ordinary traffic, draws of the scenarios and half of the
failures that a search has found, and learns labels of an expert that keeps 0.3 s, and may only ask for more
braking. In ordinary traffic and where recorded people were, the label is what the ego did before, so that it forgets
nothing.

Writes `driver.safetensors` and `rounds.json` into the folder. A training that was stopped before the corrections is
taken up.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor, nn

from agents import LearnedDriver, LearnedEgo, Provenance, save_driver
from agents.learned.networks import Policy
from rare_envs.control.idm import IDM
from rare_envs.files import replace_text
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario, scenario_named
from rare_envs.simulation.world import Clock, Sensing, World, drive
from rare_envs.startup import use_one_thread
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State
from training.command_line import RunFolderOption, report_errors, run_command
from training.data.scenes import TrafficScene
from training.imitation.config import Config
from training.imitation.evaluate import header_metrics
from training.imitation.learner import Learner
from training.imitation.traffic import collect_pairs, stack_scenes
from training.imitation.train import (
    DRIVER,
    Data,
    Source,
    claim_folder,
    driver_of,
    load_scenes,
    make_learner,
    train_learner,
)
from training.recipes.ordinary_traffic import CASES, Search, correct, draw_inputs, judge_all_cases, learn, make_world

FloatArray = NDArray[np.float64]
Labelled = tuple[Tensor, Tensor]
"""What an ego perceives (m, 51) and the right outputs (m, 4)."""
SENSING = Sensing("features", lidar=True)
CONFIG = Config(
    method="mgail",
    updates=1000,
    age=(30, 60),  # encounters are over by then, and what comes after them teaches little
    critic_weight=2.0,
    clone_weight=(0.1, 0.03),
    collision_weight=32.0,
    edge_weight=16.0,
    brake_weight=0.3,
    headway_weight=10.0,
    lane_weight=8.0,
    speed_weight=8.0,
)
RECORDED = 0.4
"""Share of recorded ones among the scenes that are driven."""
APART, SCENE_VEHICLES = 1500.0, 39
"""Distance of neighbouring encounters at their start [m], several times the range of every sensor; most vehicles of a
scene."""
SEARCHED = (("rare_envs/CutIn-v0", "us101"), ("rare_envs/CutIn-v1", "us101"))
"""Scenarios and bases in which failures are searched."""
DRAWN = (
    *SEARCHED,
    ("rare_envs/CutIn-v0", "us101-15-offsets"),
    ("rare_envs/CutIn-v0", "highway"),
    ("rare_envs/HardBrake-v0", "us101"),
    ("rare_envs/CarFollowing-v0", "us101-gap"),
    ("rare_envs/CarFollowing-v0", "highway"),
)
"""Scenarios and bases that are driven by draws."""
EXPERT = IDM(
    desired_speed=40.0,
    time_headway=0.3,
    jam_distance=1.5,
    jam_distance_speed=0.0,
    max_deceleration=8.0,
    cut_off=True,
)
"""How the expert follows: closer than the ego does in ordinary traffic, so that it overrules the ego in danger only."""
LOOK_AHEAD, SIDE_MARGIN, LEAST_APPROACH = 1.0, 0.5, 0.3
"""The expert brakes for whoever is within this margin of the ego's path [m], or will be within this time [s], coming
nearer at more than this speed [m/s]."""
FREE = 4.0
"""Acceleration of the expert with nobody ahead [m/s^2], the limit of learned drivers; the ego's own is less."""
OUTPUT_WEIGHTS = (1.0, 3.0, 0.3, 0.3)
"""Weights of the outputs in the loss: acceleration, yaw rate and the logarithms of their standard deviations."""
JUDGED, JUDGED_SEED = 400, 1000
"""Rollouts of each case of ordinary traffic in the header of the file, and their seed."""


class EncounterSpec(NamedTuple):
    """Encounters of one kind."""

    scenario: str
    """Short name or id of a scenario, or one of `CASES` on a straight road."""
    base: str | None
    scenes: int
    seconds: float
    """Length [s]; the others keep their speed afterwards."""
    given: tuple[tuple[str, float], ...] = ()
    """Parameters with a fixed value."""


ENCOUNTERS = (
    EncounterSpec("rare_envs/CutIn-v0", "us101-15-offsets", 20, 4.0),
    EncounterSpec("rare_envs/CutIn-v0", "highway", 10, 4.0),
    EncounterSpec("hard_brake", "us101", 8, 8.0),
    EncounterSpec("car_following", "us101-gap", 2, 8.0),
    EncounterSpec("car_following", "highway", 2, 8.0),
    EncounterSpec("straight", None, 10, 30.0),
    EncounterSpec("straight", None, 2, 30.0, (("gap", 140.0), ("lead_speed", 25.0))),
    EncounterSpec("car_following", "highway", 2, 8.0, (("gap", 140.0),)),
)
"""Encounters of the training; in the last two the lead is out of sight."""


@dataclass(frozen=True)
class Corrections:
    """Amounts of the corrections.

    In a round: draws of each scenario, drives of a minute in each case of `ordinary` traffic, simulations of each
    search for failures, gradient steps. Moments of recorded people, at which the ego is to do what it did, are drawn
    once.
    """

    seed: int = 0
    rounds: int = 1
    draws: int = 1000
    recorded: int = 100_000
    ordinary: int = 100
    simulations: int = 2000
    steps: int = 3000
    batch: int = 1024
    rate: float = 5e-4


def make_scenes(kinds: Sequence[EncounterSpec], rng: np.random.Generator) -> list[TrafficScene]:
    """Return scenes full of encounters; every other one is mirrored, since scenarios have one side only."""
    scenes = []
    for kind in kinds:
        case, clock = CASES.get(kind.scenario), Clock(horizon=kind.seconds)
        world = make_world(case, kind.seconds) if case else World(scenario_named(kind.scenario), clock=clock)
        each = SCENE_VEHICLES // world.scenario.vehicles
        n = each * kind.scenes
        if case:
            x = draw_inputs(case, world, n, 0, rng)
        else:
            x = np.asarray(load_base(world.scenario, kind.base).sample(n, rng))
        names = [parameter.name for parameter in world.scenario.parameters]
        for name, value in kind.given:
            x[:, names.index(name)] = value
        with torch.inference_mode():
            states = [episode.state for episode in drive(world, IDM(), torch.from_numpy(x))]
            tracks = torch.stack([torch.stack((s.x, s.y, s.heading, s.speed)) for s in states], dim=1).numpy()
        for number, part in enumerate(np.split(tracks, kind.scenes, axis=2)):
            name = f"{kind.scenario} {kind.base or ''} {number}"
            scenes.append(_make_scene(name, world, part, -1.0 if number % 2 else 1.0))
    return scenes


def _make_scene(name: str, world: World, tracks: FloatArray, side: float) -> TrafficScene:
    """Return one scene of n encounters with x, y, heading and speed (4, T, n, N), mirrored for side = -1."""
    x, y, heading, speed = tracks
    ticks, n, vehicles = x.shape
    flat = {"x": x + APART * np.arange(n)[:, None], "y": side * y, "heading": side * heading, "speed": speed}
    # vehicles without actions are replayed; the actions of the ego are not learned from, so zeros do
    action = np.where(np.arange(n * vehicles) % vehicles == 0, 0.0, np.nan) * np.ones((ticks, 1))
    return TrafficScene(
        name=name,
        start=0.0,
        edges=tuple(sorted(side * edge for edge in world.scenario.road.edges)),
        **{key: values.reshape(ticks, n * vehicles) for key, values in flat.items()},
        acceleration=action,
        yaw_rate=action.copy(),
        present=np.ones((ticks, n * vehicles), dtype=bool),
        length=np.full(n * vehicles, VEHICLE_LENGTH),
        width=np.full(n * vehicles, VEHICLE_WIDTH),
    )


def prepare_learner(scenes: Sequence[TrafficScene], kinds: Sequence[EncounterSpec], config: Config) -> Learner:
    """Return the learner before its first update; likelihood and critic know the recorded scenes only."""
    pairs = collect_pairs(stack_scenes(scenes))
    met = make_scenes(kinds, np.random.default_rng(config.seed))
    recorded = torch.unique(pairs.scene)
    times = round(RECORDED / (1.0 - RECORDED) * len(met) / len(recorded))
    among = torch.cat((recorded.repeat(max(times, 1)), len(scenes) + torch.arange(len(met))))
    return make_learner(Data(stack_scenes((*scenes, *met)), pairs, None), config, among)


def expert_acceleration(state: State) -> Tensor:
    """Return what the expert does [m/s^2], shape (B,): IDM behind the vehicle ahead that asks for the hardest braking.

    Ahead are those in the ego's path, and those that come into it within `LOOK_AHEAD`.
    """
    own, others = state.speed[:, :1], state.speed[:, 1:]
    aside, across = state.y[:, 1:] - state.y[:, :1], others * torch.sin(state.heading[:, 1:])
    soon, reach = aside + LOOK_AHEAD * across, VEHICLE_WIDTH + SIDE_MARGIN
    comes = (-aside.sign() * across > LEAST_APPROACH) & ((soon.abs() < reach) | (aside * soon < 0.0))
    in_path = (aside.abs() < reach) | comes
    gap = state.x[:, 1:] - state.x[:, :1] - VEHICLE_LENGTH
    closing = own * torch.cos(state.heading[:, :1]) - others * torch.cos(state.heading[:, 1:])
    wanted = EXPERT.acceleration(own.expand_as(gap), Lead(gap.clamp(min=0.3), closing))
    ahead = in_path & (gap > -VEHICLE_LENGTH)
    return torch.where(ahead, wanted, FREE).clamp(max=FREE).amin(dim=1)


@torch.inference_mode()
def record_drive(
    driver: LearnedDriver, teacher: Policy, world: World, x: FloatArray, every: int, corrected: bool
) -> Labelled:
    """Let an ego drive x (n, d); return what it perceives until it collides with the right outputs.

    The right ones are those of the teacher, the network before all corrections; if corrected, the expert may ask for
    less acceleration. Moments are so many ticks apart.
    """
    rows = []
    for tick, episode in enumerate(drive(world, LearnedEgo(driver), torch.from_numpy(x).float())):
        if tick % every:
            continue
        assert episode.perception is not None
        seen = episode.perception[:, 0]
        right = torch.cat(teacher(seen), dim=1)
        if corrected:
            mean, std = teacher.scaling.action_mean[0], teacher.scaling.action_std[0]
            right[:, 0] = torch.minimum(right[:, 0], (expert_acceleration(episode.state) - mean) / std)
        rows.append((seen[~episode.collided], right[~episode.collided]))
    features, outputs = (torch.cat(column) for column in zip(*rows, strict=True))
    return features, outputs


def learn_labels(policy: Policy, data: Sequence[Labelled], plan: Corrections, rng: np.random.Generator) -> None:
    """Train a network on labelled perceptions."""
    features, outputs = (torch.cat(column).clone() for column in zip(*data, strict=True))  # of inference mode
    weights = outputs.new_tensor(OUTPUT_WEIGHTS)

    def loss() -> Tensor:
        some = torch.from_numpy(rng.integers(0, len(features), plan.batch))
        given = torch.cat(policy(features[some]), dim=1)
        errors = nn.functional.smooth_l1_loss(given, outputs[some], reduction="none", beta=0.3)
        return (weights * errors).mean()

    policy.requires_grad_(True)
    learn(list(policy.parameters()), loss, plan.steps, plan.rate)
    policy.requires_grad_(False)


def correct_ego(
    before: LearnedDriver, plan: Corrections, recorded: Tensor
) -> tuple[LearnedDriver, list[dict[str, Any]]]:
    """Return a corrected ego, which keeps what it did where people were (n, 51), and the records of `correct`."""
    rng, teacher = np.random.default_rng(plan.seed), before.policy
    driver = replace(before, policy=copy.deepcopy(teacher))
    some = recorded[torch.from_numpy(rng.integers(0, len(recorded), plan.recorded))]
    with torch.inference_mode():
        data = [(some, torch.cat(teacher(some), dim=1))]

    def learn_from(searches: Sequence[Search]) -> None:
        for search in searches:
            if len(search.driven):
                world = World(find_scenario(search.record["env_id"]), SENSING)
                data.append(record_drive(driver, teacher, world, search.driven, 2, corrected=True))
        for case in CASES.values():
            world = make_world(case)
            x = draw_inputs(case, world, plan.ordinary, 0, rng)
            data.append(record_drive(driver, teacher, world, x, 10, corrected=False))
        for env_id, base in DRAWN:
            scenario = find_scenario(env_id)
            x = np.asarray(load_base(scenario, base).sample(plan.draws, rng))
            data.append(record_drive(driver, teacher, World(scenario, SENSING), x, 3, corrected=True))
        learn_labels(driver.policy, data, plan, rng)

    options = {"max_sim": plan.simulations}
    return driver, correct(lambda: LearnedEgo(driver), SEARCHED, plan.rounds, plan.seed, rng, learn_from, **options)


@use_one_thread()
def main(
    out: RunFolderOption,
    data: Annotated[Path, typer.Option(help="Folder with the compact tables of US 101.")],
    seed: Annotated[int, typer.Option(help="The same seed gives the same weights.")] = 0,
) -> None:
    """Train and correct the ego `imitation`."""
    config, source = replace(CONFIG, seed=seed), Source("data", data)
    with report_errors("imitation"):
        with claim_folder(out, source, config):
            learning, test = load_scenes(source)
        learner = prepare_learner(learning, ENCOUNTERS, config)
    before = replace(driver_of(train_learner(learner, out, progress=True), config), name="imitation")
    driver, records = correct_ego(before, Corrections(seed=seed), collect_pairs(stack_scenes(learning)).features)
    replace_text(out / "rounds.json", json.dumps(records, indent=1) + "\n")
    provenance = Provenance(
        kind="mgail, with encounters, corrected",
        command=f"python -m training.recipes.imitation --data {data.name} --seed {seed}",
        data=source.description,
        data_licence=source.licence,
        metrics={
            **header_metrics(stack_scenes(test), driver),
            "ordinary": judge_all_cases(LearnedEgo(driver), JUDGED, JUDGED_SEED),
        },
    )
    print(f"Saved {save_driver(driver, provenance, out / DRIVER)}.")


if __name__ == "__main__":
    run_command(main)
