"""How human are the drivers? All vehicles of held-out scenes driven by each, compared with the people in them.

    python -m benchmarks.driving.realism DATA [DRIVER ...] [--json FILE]

DATA is the folder with the tables of US 101; drivers are files or the names of shipped ones. Prints a table and writes
`benchmarks/results/imitation.json`. Beside the drivers stand the record itself, constant velocity and IDM with lane
keeping; of a driver that has a distribution of its weights, policies drawn from it too.

Each driver is measured with several sequences of noise; standard errors are by bootstrap over the test scenes, which
share vehicles, so they are rather too small. Divergences are from the people in the test scenes; those of the record
are between its training and its test scenes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from torch import Tensor

from agents import LearnedDriver, load_driver
from agents.learned.driver import RuleDriver
from agents.learned.networks import ACTION_SIZE
from benchmarks import RESULTS, format_table
from benchmarks.samplers.runs import about
from rare_envs.startup import use_one_thread
from training.imitation.evaluate import (
    BINS,
    Act,
    Realism,
    Tallies,
    collect_statistics,
    record_statistics,
    sampling_driver,
    summarise_realism,
)
from training.imitation.traffic import Recording, stack_scenes
from training.imitation.train import Source, load_scenes

SECONDS = (10.0, 20.0)
"""Times for which scenes are driven [s]."""
RATES = ("collision", "ever", "off_road", "hard_brake", "lane_changes")
ERRORS = ("position", "speed", "lateral")
Row = dict[str, Any]


def constant_velocity(features: Tensor, memory: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Return actions that change neither speed nor heading."""
    return features.new_zeros(*features.shape[:2], ACTION_SIZE), None


def rule_driver(features: Tensor, memory: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Return actions of IDM and lane keeping."""
    return RuleDriver().act(features, None, None, memory)


def bootstrap_errors(driven: Tallies, recorded: Tallies, rng: np.random.Generator, draws: int = 200) -> Realism:
    """Return standard errors by bootstrap over scenes; scenes that share vehicles are taken as independent."""
    scenes = len(driven["steps"])
    drawn = [
        asdict(summarise_realism(driven, recorded, times))
        for times in rng.multinomial(scenes, [1 / scenes] * scenes, draws)
    ]

    def spread(values: list[Any]) -> Any:
        if isinstance(values[0], dict):
            return {key: spread([value[key] for value in values]) for key in values[0]}
        return float(np.std(values, ddof=1))

    return Realism(**{name: spread([one[name] for one in drawn]) for name in drawn[0]})


def summarise(recorded: Tallies, name: str, kind: str, runs: dict[float, list[Tallies]]) -> Row:
    """Return values and standard errors of several runs together, and the collision rate of each, beside a record."""
    out: Row = {"name": name, "kind": kind}
    for seconds, parts in runs.items():
        whole = {name: np.sum([part[name] for part in parts], axis=0) for name in parts[0]}
        out[f"{seconds:g} s"] = {
            **asdict(summarise_realism(whole, recorded)),
            "standard_error": asdict(bootstrap_errors(whole, recorded, np.random.default_rng(0))),
            "collisions": [summarise_realism(part, recorded).collision for part in parts],
        }
    return out


def noisy_drivers(driver: LearnedDriver, number: int, weights: Tensor | None = None) -> list[Act]:
    """Return a driver with several sequences of noise."""
    return [sampling_driver(driver, torch.Generator().manual_seed(seed), weights) for seed in range(number)]


def measure_all(
    train: Recording,
    test: Recording,
    drivers: dict[str, LearnedDriver],
    noises: int,
    draws: int,
    say: Callable[[str], None] = lambda text: None,
) -> list[Row]:
    """Return all rows, ready for JSON.

    Drivers have learned from the scenes `train` and not from `test`. Each is driven with a number of sequences of
    noise, and so many policies drawn from the distribution of its weights with one; `say` is told each name.
    """
    recorded = record_statistics(test)

    def row(name: str, kind: str, acts: Sequence[Act]) -> Row:
        say(name)
        runs = [collect_statistics(test, act, SECONDS) for act in acts]
        return summarise(recorded, name, kind, {time: [run[time] for run in runs] for time in SECONDS})

    people = summarise(recorded, "people", "reference", {time: [recorded] for time in SECONDS})
    learned = summarise_realism(record_statistics(train), recorded)
    for seconds in SECONDS:  # divergences between training and test scenes
        people[f"{seconds:g} s"]["divergence"] = learned.divergence
        people[f"{seconds:g} s"]["hard_brake_in_training_scenes"] = learned.hard_brake
    rules = {"constant velocity": constant_velocity, "IDM, lane keeping": rule_driver}
    rows = [people, *(row(name, "reference", [act]) for name, act in rules.items())]
    for name, driver in drivers.items():
        rows.append(row(name, "driver", noisy_drivers(driver, noises)))
        if driver.weights is not None:
            weights = torch.from_numpy(driver.weights.sample(draws, np.random.default_rng(0))).float()
            acts = [noisy_drivers(driver, 1, each)[0] for each in weights]
            rows.append(row(f"{name}, drawn from its distribution", "distribution", acts))
    return rows


def format_realism(rows: Sequence[Row], seconds: str) -> str:
    """Return the rows over one time, such as "10 s", as a table in Markdown; standard errors in brackets."""
    heads = ["driver", *RATES, "speed", *(f"JS {name}" for name in BINS), f"RMSE 5 s: {', '.join(ERRORS)}"]
    lines = []
    for row in rows:
        one = row[seconds]
        rates = [f"{one[name]:.4f} ({one['standard_error'][name]:.4f})" for name in RATES]
        apart = [f"{one['divergence'][name]:.3f}" for name in BINS]
        errors = "/".join(f"{one['rmse'][name]:.2f}" for name in ERRORS) if one["rmse"] else ""
        lines.append([row["name"], *rates, f"{one['mean_speed']:.1f}", *apart, errors])
    return format_table(heads, lines)


def load_named(words: Sequence[str]) -> dict[str, LearnedDriver]:
    """Return drivers by shipped names, stems of files, or folders of trainings."""
    out = {}
    for word in words:
        driver, path = load_driver(word), Path(word)
        if not isinstance(driver, LearnedDriver):
            raise typer.BadParameter(f"{word!r} has not been learned; IDM is measured anyway.")
        out[path.parent.name if path.stem == "driver" else path.stem] = driver
    return out


def round_numbers(value: Any) -> Any:
    """Return numbers with five significant digits."""
    if isinstance(value, dict):
        return {name: round_numbers(part) for name, part in value.items()}
    if isinstance(value, list):
        return [round_numbers(part) for part in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    drivers: Annotated[list[str] | None, typer.Argument(help="Files or shipped names; gail and mgail if none.")] = None,
    result: Annotated[Path, typer.Option("--json", help="File for the result.")] = RESULTS / "imitation.json",
    noises: Annotated[int, typer.Option(help="Sequences of noise of each driver.")] = 3,
    draws: Annotated[int, typer.Option(help="Policies drawn from each distribution.")] = 6,
) -> None:
    """Measure how human drivers are."""
    begun = time.perf_counter()
    train, test = (stack_scenes(scenes) for scenes in load_scenes(Source("data", data)))

    def say(text: str) -> None:
        print(f"{time.perf_counter() - begun:5.0f} s  {text}", flush=True)

    rows = measure_all(train, test, load_named(drivers or ["gail", "mgail"]), noises, draws, say)
    facts = about(torch=torch.__version__, noises=noises, draws=draws, seconds=round(time.perf_counter() - begun))
    found = round_numbers({"realism": rows, "bins": {name: list(bins) for name, bins in BINS.items()}, "about": facts})
    result.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    for seconds in SECONDS:
        print(f"\n{seconds:g} s:\n\n{format_realism(rows, f'{seconds:g} s')}")


if __name__ == "__main__":
    typer.run(main)
