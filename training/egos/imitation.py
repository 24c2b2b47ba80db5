"""Training of the ego `imitation`: a driver learned from recorded people and from encounters that are rare in records.

    python -m training.egos.imitation --data FOLDER --out runs/imitation

It is trained as the drivers of the traffic are (`training.imitation`): likelihood and critic use recorded people only,
and the gradient goes through the simulator. Two things differ. Beside recorded scenes it drives encounters
(`training.egos.encounters`): vehicles that cut in, brake hard, or are absent. And its loss has penalties on following
closely, leaving the middle of the lane and speeding, which are stricter than recorded driving.

Writes `driver.safetensors` into the folder, with how it does in ordinary traffic (`training.egos.nominal_driving`) in
its header, and a checkpoint. The same command on the same folder resumes an interrupted training, to the same weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from agents import LearnedEgo, Provenance, save_driver
from rare_envs.threads import use_one_thread
from training.command_line import RunFolderOption, report_errors, run_command
from training.data.scenes import TrafficScene
from training.egos.encounters import EncounterSpec, make_scenes
from training.egos.nominal_driving import judge_all_cases
from training.imitation.clone import collect_pairs
from training.imitation.config import Config
from training.imitation.evaluate import header_metrics
from training.imitation.learner import Learner
from training.imitation.traffic import stack_scenes
from training.imitation.train import (
    DRIVER,
    Data,
    Source,
    check_folder,
    driver_of,
    format_settings,
    load_scenes,
    make_learner,
    train_learner,
    write_settings,
)

NAME = "imitation"
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
ENCOUNTERS = (
    EncounterSpec("rare_envs/CutIn-v0", "us101-15-offsets", 20, 4.0),
    EncounterSpec("rare_envs/CutIn-v0", "highway", 10, 4.0),
    EncounterSpec("hard_brake", "us101-all-brakings", 8, 8.0),
    EncounterSpec("car_following", "us101-gap", 2, 8.0),
    EncounterSpec("car_following", "highway", 2, 8.0),
    EncounterSpec("straight", None, 10, 30.0),
    EncounterSpec("straight", None, 2, 30.0, {"gap": 140.0, "lead_speed": 25.0}),
    EncounterSpec("car_following", "highway", 2, 8.0, {"gap": 140.0}),
)
"""Encounters of the training; in the last two the lead is out of sight."""
RECORDED = 0.4
"""Share of recorded ones among the scenes that are driven."""
JUDGED, JUDGED_SEED = 400, 1000
"""Rollouts of each case in the header of the file, and their seed."""


def prepare_learner(scenes: Sequence[TrafficScene], kinds: Sequence[EncounterSpec], config: Config) -> Learner:
    """Return the learner before its first update.

    Args:
        scenes: Recorded ones; likelihood and critic know these only.
        kinds: Encounters that are driven beside them.
        config: Settings; the encounters are drawn by its seed.
    """
    pairs = collect_pairs(stack_scenes(scenes))
    met = make_scenes(kinds, np.random.default_rng(config.seed))
    recorded = torch.unique(pairs.scene)
    times = round(RECORDED / (1.0 - RECORDED) * len(met) / len(recorded))
    among = torch.cat((recorded.repeat(max(times, 1)), len(scenes) + torch.arange(len(met))))
    return make_learner(Data(stack_scenes((*scenes, *met)), pairs, None), config, among)


def train_imitation_ego(
    data: Path,
    config: Config,
    out: Path,
    *,
    kinds: Sequence[EncounterSpec] = ENCOUNTERS,
    rollouts: int = JUDGED,
    progress: bool = False,
) -> Path:
    """Train the ego from the tables of US 101, from the first update or from an interrupted training.

    Args:
        data: Folder with the tables.
        config: Settings.
        out: Folder; it is made if there is none.
        kinds: Encounters.
        rollouts: How many it is judged by in each case of ordinary traffic.
        progress: Show a bar on standard error.

    Returns:
        The ego's file.

    Raises:
        ValueError: If the data cannot be read, or the folder holds another training.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:  # doctest: +ELLIPSIS
        ...     train_imitation_ego(Path("no/such/folder"), CONFIG, Path(folder))
        Traceback (most recent call last):
        ...
        ValueError: There is no ngsim_us101_scenes.parquet in the folder ...
    """
    source = Source("data", data)
    settings = format_settings(source, config)
    check_folder(out, settings)
    learn, test = load_scenes(source)
    write_settings(out, settings)
    driver = replace(
        driver_of(train_learner(prepare_learner(learn, kinds, config), out, progress=progress), config), name=NAME
    )
    provenance = Provenance(
        kind="mgail, with encounters",
        command=f"python -m training.egos.imitation --data {data.name} --seed {config.seed}",
        data=source.description,
        data_licence=source.licence,
        metrics={
            **header_metrics(stack_scenes(test), driver),
            "ordinary": judge_all_cases(LearnedEgo(driver), rollouts, JUDGED_SEED),
        },
    )
    return save_driver(driver, provenance, out / DRIVER)


@use_one_thread()
def main(
    out: RunFolderOption,
    data: Annotated[Path, typer.Option(help="Folder with the compact tables of US 101.")],
    seed: Annotated[int, typer.Option(help="The same seed gives the same weights.")] = CONFIG.seed,
) -> None:
    """Train the ego `imitation`."""
    with report_errors("imitation"):
        path = train_imitation_ego(data, replace(CONFIG, seed=seed), out, progress=True)
    print(f"Saved {path}. Next: python -m training.egos.nominal_driving --ego {path}")


if __name__ == "__main__":
    run_command(main)
