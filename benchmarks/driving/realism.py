"""How human are the drivers? All vehicles of held-out scenes driven by each, compared with the people in them.

    python -m benchmarks.driving.realism DATA [DRIVER ...] --out FOLDER

DATA is the folder with the tables of US 101; drivers are files or the names of shipped ones. Writes
`benchmarks/results/imitation.json`, and `imitation.md` (tables) and figures into FOLDER. Beside the drivers stand the
record itself, constant velocity and IDM with lane keeping; of a driver that has a distribution of its weights, policies
drawn from it and policies moved within a search box too.

Each driver is measured with several sequences of noise; standard errors are by bootstrap over the test scenes, which
share vehicles, so they are rather too small. Divergences are from the people in the test scenes; those of the record
are between its training and its test scenes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from torch import Tensor

from agents import LearnedDriver, load_driver, read_driver
from agents.learned.networks import ACTION_SIZE
from agents.learned.rule_driver import RuleDriver
from benchmarks import RESULTS
from benchmarks.driving.realism_figures import format_tables, write_figures
from benchmarks.driving.realism_rows import (
    Effort,
    Judge,
    measure_boxes,
    measure_drawn,
    measure_errors,
    measure_on_highway,
    measure_people,
    noisy_drivers,
)
from rare_envs.threads import use_one_thread
from samplers.benchmark.runs import about
from training.imitation.algorithms.expert_pairs import collect_pairs
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.behaviour import Act
from training.imitation.evaluation.driving_statistics import BINS
from training.imitation.evaluation.realism import record_statistics
from training.imitation.traffic.recording import Recording, stack_scenes


def constant_velocity(features: Tensor, memory: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Return actions that change neither speed nor heading."""
    return features.new_zeros(*features.shape[:2], ACTION_SIZE), None


def rule_driver(features: Tensor, memory: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Return actions of IDM and lane keeping."""
    return RuleDriver().act(features, None, None, memory)


def measure_all(
    train: Recording,
    test: Recording,
    drivers: dict[str, LearnedDriver],
    effort: Effort,
    say: Callable[[str], None] = lambda text: None,
    weights: bool = True,
) -> dict[str, Any]:
    """Return everything that is measured, ready for JSON.

    Args:
        train: Scenes that the drivers learned from.
        test: Scenes that they did not.
        drivers: Drivers by name.
        effort: Amount of simulation.
        say: Function that is called with the name of each measurement.
        weights: Whether policies with drawn and moved weights are measured too.
    """
    judge = Judge(test, record_statistics(test), effort)
    features = collect_pairs(test).features
    rules: dict[str, Act] = {"constant velocity": constant_velocity, "IDM, lane keeping": rule_driver}
    rows = [measure_people(train, judge)]
    errors, highways = {}, []
    for name, act in rules.items():
        say(name)
        rows.append(judge.row(name, "reference", [act]))
        errors[name] = measure_errors(test, act, effort, rollouts=1)
        highways.append(measure_on_highway(name, act, judge))
    for name, driver in drivers.items():
        say(name)
        rows.append(judge.row(name, "driver", noisy_drivers(driver, effort.noises)))
        errors[name] = measure_errors(test, noisy_drivers(driver, 1)[0], effort)
        highways.append(measure_on_highway(name, noisy_drivers(driver, 1)[0], judge))
        if weights and driver.weights is not None:
            say(f"{name}, weights drawn and moved")
            rows += [measure_drawn(name, driver, judge), *measure_boxes(name, driver, features, judge)]
    return {
        "realism": rows,
        "replayed": errors,
        "highway": highways,
        "bins": {name: list(bins) for name, bins in BINS.items()},
    }


def load_named(words: Sequence[str]) -> dict[str, LearnedDriver]:
    """Return drivers by shipped names, stems of files, or folders of trainings."""
    out = {}
    for word in words:
        path = Path(word)
        driver = read_driver(path) if path.suffix else load_driver(word)
        if not isinstance(driver, LearnedDriver):
            raise typer.BadParameter(f"{word!r} has not been learned; IDM is measured anyway.")
        out[path.parent.name if path.stem == "driver" else path.stem] = driver
    return out


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    drivers: Annotated[
        list[str] | None, typer.Argument(help="Files or shipped names; mgail, gail and bc if none.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for tables and figures.")] = Path("imitation"),
    result: Annotated[Path, typer.Option("--json", help="File for the result.")] = RESULTS / "imitation.json",
    noises: Annotated[int, typer.Option(help="Sequences of noise of each driver.")] = Effort.noises,
    draws: Annotated[int, typer.Option(help="Policies drawn from distributions and boxes.")] = Effort.draws,
    rollouts: Annotated[int, typer.Option(help="Of each segment among recorded others.")] = Effort.rollouts,
    weights: Annotated[bool, typer.Option(help="Measure drawn and moved weights too.")] = True,
) -> None:
    """Measure how human drivers are, and draw it."""
    begun = time.perf_counter()
    effort = replace(Effort(), noises=noises, draws=draws, rollouts=rollouts)
    train, test = (stack_scenes(scenes) for scenes in load_scenes(Source("data", data)))
    chosen = load_named(drivers or ["mgail", "gail", "bc"])
    found = measure_all(
        train,
        test,
        chosen,
        effort,
        lambda text: print(f"{time.perf_counter() - begun:5.0f} s  {text}", flush=True),
        weights,
    )
    found["about"] = about(torch=torch.__version__, **asdict(effort), seconds=round(time.perf_counter() - begun))
    out.mkdir(parents=True, exist_ok=True)
    result.write_text(json.dumps(round_numbers(found), indent=1) + "\n", encoding="utf-8")
    (out / "imitation.md").write_text(format_tables(found), encoding="utf-8")
    write_figures(found, out)
    print(format_tables(found))


def round_numbers(value: Any) -> Any:
    """Return numbers with five significant digits."""
    if isinstance(value, dict):
        return {name: round_numbers(part) for name, part in value.items()}
    if isinstance(value, list):
        return [round_numbers(part) for part in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


if __name__ == "__main__":
    typer.run(main)
