"""Further training in stop-and-go traffic: does a driver that piles up in dense traffic learn to drive there?

    python -m benchmarks.driving.flow.stop_and_go_training DATA --out FILE [--driver mgail] [--rule-weight 0.2]
        [--updates 150] [--share 1] [--damping 0.4] [--seed 0] [--test]

Fine-tunes the driver (`training.imitation.fine_tuning`) and prints how it does before and after: in the scenes that it
has learned from, or with `--test` in the others, and on dense rings (`benchmarks.driving.flow.long_drives`). `--share`
goes a part of the way from the weights before to those after; `--damping` is that of the driver's noise afterwards.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from agents import LearnedDriver, Provenance, load_driver, save_driver
from benchmarks.driving.flow.long_drives import ROWS, SECONDS, drive_long, start_column, summarise_drive
from benchmarks.driving.realism_score import by_features
from rare_envs.threads import use_one_thread
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.behaviour import sampling_driver
from training.imitation.evaluation.realism import record_statistics
from training.imitation.fine_tuning import (
    FINE_TUNING,
    RULE_WEIGHT,
    StopAndGo,
    fine_tune,
    make_fine_tuning,
    mix_drivers,
)
from training.imitation.fit import prepare_data
from training.imitation.noise_damping import damp_acceleration, format_row, measure_driver
from training.imitation.traffic.recording import stack_scenes

DENSITIES = (35.0, 45.0, 60.0)
"""Vehicles per km and lane on the rings."""
DENSE_SCENES = 60
"""Number of stop-and-go scenes."""


def ring_rows(name: str, driver: LearnedDriver, seed: int = 0) -> list[str]:
    """Return the lines of a driver's table: a ring each, with starts and noise of the same seed."""
    rows = []
    for density in DENSITIES:
        decide = by_features(sampling_driver(driver, torch.Generator().manual_seed(seed)))
        start = start_column(density, np.random.default_rng(seed))
        found = summarise_drive(drive_long(start, decide, 1000.0 * ROWS / density, SECONDS), density)
        shares = " | ".join(f"{found[share]:.4f}" for share in ("collision", "stopped", "hard_brake"))
        rows.append(f"| {name} | {density:g} | {found['speed']:.1f} | {found['flow']:.0f} | {shares} |")
    return rows


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    out: Annotated[Path, typer.Option(help="File of the driver, .safetensors.")],
    driver: Annotated[str, typer.Option(help="Name or file of the driver to go on from.")] = "mgail",
    rule_weight: Annotated[float, typer.Option(min=0.0, help="Weight of the IDM's accelerations.")] = RULE_WEIGHT,
    updates: Annotated[int, typer.Option(min=1, help="Number of updates.")] = FINE_TUNING.updates,
    share: Annotated[float, typer.Option(min=0.0, max=1.0, help="Of the way from the weights before.")] = 1.0,
    damping: Annotated[float | None, typer.Option(help="Of the noise afterwards [1/s]; that of training.")] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same weights.")] = 0,
    in_test: Annotated[bool, typer.Option("--test", help="Measure in the test scenes.")] = False,
) -> None:
    """Fine-tune a driver, measure it, and write its file."""
    before, source = load_driver(driver), Source("data", data)
    if not isinstance(before, LearnedDriver):
        raise typer.BadParameter(f"Expected a learned driver to go on from, got the rule {driver!r}.")
    learn, test = load_scenes(source)
    learner = make_fine_tuning(prepare_data(learn), before, replace(FINE_TUNING, updates=updates, seed=seed))
    tuned = fine_tune(learner, StopAndGo.draw(DENSE_SCENES, seed, rule_weight))
    after = replace(mix_drivers(before, tuned, share), name=out.stem)
    if damping is not None:
        after = replace(after, colour=damp_acceleration(before.colour, damping))
    words = f"--driver {driver} --rule-weight {rule_weight:g} --updates {updates} --share {share:g} --seed {seed}"
    provenance = Provenance(
        kind=f"{before.name}, fine-tuned in stop-and-go traffic",
        command=f"python -m benchmarks.driving.flow.stop_and_go_training data --out OUT {words}"
        + ("" if damping is None else f" --damping {damping:g}"),
        data=source.description,
        data_licence=source.licence,
    )
    save_driver(after, provenance, out)
    scenes = stack_scenes(test if in_test else learn)
    recorded, named = record_statistics(scenes), {"before": before, "after": after}
    print("| driver | collision 10 s / 20 s | off road | hard brake | lane changes per 10 s | ", end="")
    print("JS acceleration | jerk | yaw rate | inverse TTC | position after 5 s, m |")
    print("|" + "---|" * 10)
    for name, each in named.items():
        print(format_row(name, measure_driver(scenes, recorded, each, seed)), flush=True)
    print("\n| driver | density, 1/km | speed, m/s | flow, 1/h | collision | stopped | hard brake |")
    print("|" + "---|" * 7)
    for name, each in named.items():
        print("\n".join(ring_rows(name, each, seed=seed)), flush=True)


if __name__ == "__main__":
    typer.run(main)
