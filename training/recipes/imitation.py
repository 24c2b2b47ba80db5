"""The ego `imitation`, learned from recorded people and encounters, and the drivers of the traffic `gail` and `mgail`.

    python -m training.recipes.imitation --data TABLES --out runs/imitation
    python -m training.recipes.imitation --driver mgail --data TABLES --out runs/mgail

`gail` and `mgail` are trained on US 101, each with the distribution of its last layer's weights. The rules beside the
network of the shipped `mgail` are settings of `agents.load_driver`.

`imitation` is trained as these are (`training.imitation`): likelihood and critic use recorded people only, and the
gradient goes through the simulator. Two things differ. Beside recorded scenes it drives encounters: draws of
this project's scenarios, which the others replay, many behind each other on one road. And its loss has penalties on
following closely, leaving the middle of the lane and speeding.

The shipped file was corrected once after such a training, on failures in scripted cut-ins: its header names the code.

A training that was stopped is taken up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from agents import LearnedEgo, Provenance, save_driver
from rare_envs.control.idm import IDM
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.settings import Clock
from rare_envs.simulation.world import World, drive
from rare_envs.startup import use_one_thread
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH
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
    train_driver,
    train_learner,
)
from training.imitation.weights import Ensemble, make_ensemble
from training.recipes.ordinary_traffic import CASES, draw_inputs, judge_all_cases, make_world

FloatArray = NDArray[np.float64]
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
DRIVER_CONFIGS = {
    "gail": Config(method="gail", updates=1100, horizon=(40, 40), critic_weight=4.5, brake_weight=2.0),
    "mgail": Config(method="mgail", updates=1500),
}
ENSEMBLES = {"gail": Ensemble(members=32, updates=30), "mgail": Ensemble(members=32, updates=60)}
RECORDED = 0.4
"""Share of recorded ones among the scenes that are driven."""
APART, SCENE_VEHICLES = 1500.0, 39
"""Distance of neighbouring encounters at their start [m], several times the range of every sensor; most vehicles of a
scene."""
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


def make_scenes(kinds: Sequence[EncounterSpec], rng: np.random.Generator) -> list[TrafficScene]:
    """Return scenes full of encounters; every other one is mirrored, since scenarios have one side only."""
    scenes = []
    for kind in kinds:
        case, clock = CASES.get(kind.scenario), Clock(horizon=kind.seconds)
        world = make_world(case, kind.seconds) if case else World(find_scenario(kind.scenario), clock=clock)
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
        for number, (x, y, heading, speed) in enumerate(np.split(tracks, kind.scenes, axis=2)):
            side, shape = -1.0 if number % 2 else 1.0, (len(x), each * x.shape[2])
            flat = {"x": x + APART * np.arange(each)[:, None], "y": side * y, "heading": side * heading, "speed": speed}
            # vehicles without actions are replayed; the actions of the ego are not learned from, so zeros do
            action = np.where(np.arange(shape[1]) % x.shape[2] == 0, 0.0, np.nan) * np.ones((len(x), 1))
            scene = TrafficScene(
                name=f"{kind.scenario} {kind.base or ''} {number}",
                start=0.0,
                edges=tuple(sorted(side * edge for edge in world.scenario.road.edges)),
                **{key: values.reshape(shape) for key, values in flat.items()},
                acceleration=action,
                yaw_rate=action.copy(),
                present=np.ones(shape, dtype=bool),
                length=np.full(shape[1], VEHICLE_LENGTH),
                width=np.full(shape[1], VEHICLE_WIDTH),
            )
            scenes.append(scene)
    return scenes


def prepare_learner(scenes: Sequence[TrafficScene], kinds: Sequence[EncounterSpec], config: Config) -> Learner:
    """Return the learner before its first update; likelihood and critic know the recorded scenes only."""
    pairs = collect_pairs(stack_scenes(scenes))
    met = make_scenes(kinds, np.random.default_rng(config.seed))
    recorded = torch.unique(pairs.scene)
    times = round(RECORDED / (1.0 - RECORDED) * len(met) / len(recorded))
    among = torch.cat((recorded.repeat(max(times, 1)), len(scenes) + torch.arange(len(met))))
    return make_learner(Data(stack_scenes((*scenes, *met)), pairs, None), config, among)


@use_one_thread()
def main(
    out: RunFolderOption,
    data: Annotated[Path, typer.Option(help="Folder with the compact tables of US 101.")],
    seed: Annotated[int, typer.Option(help="The same seed gives the same weights, of imitation.")] = 0,
    driver_name: Annotated[
        Literal["imitation", "gail", "mgail"], typer.Option("--driver", help="Which one.")
    ] = "imitation",
) -> None:
    """Train the ego `imitation`, or a driver of the traffic and an ensemble around it."""
    if driver_name != "imitation":
        with report_errors("drivers"):
            train_driver(Source("data", data), DRIVER_CONFIGS[driver_name], out, progress=True)
            path = make_ensemble(out, ENSEMBLES[driver_name], out / f"{driver_name}.safetensors", progress=True)
        print(f"Saved {path}.")
        return
    config, source = replace(CONFIG, seed=seed), Source("data", data)
    with report_errors("imitation"):
        with claim_folder(out, source, config):
            learning, test = load_scenes(source)
        learner = prepare_learner(learning, ENCOUNTERS, config)
    driver = replace(driver_of(train_learner(learner, out, progress=True), config), name="imitation")
    provenance = Provenance(
        kind="mgail, with encounters",
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
