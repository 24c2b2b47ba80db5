"""The same driver with a noise that wanders less: how does it drive for each damping of its acceleration's noise?

    python -m training.imitation.noise_damping DATA [--driver mgail] [--damping 0.6 ...] [--test] [--out FILE]

The noise of a learned driver is a damped oscillator. With less damping and the same natural frequency the
accelerations and jerks keep their variances, but swing for longer, so that they add up to less: the noise
has less power at low frequencies, which is what moves a vehicle away from where it would be. Prints how the driver
does in the scenes that it has learned from, or with `--test` in the others; with `--out` it writes the driver with the
last of the dampings, measured in the test scenes.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated

import torch
import typer

from agents import LearnedDriver, load_driver, read_provenance, save_driver
from agents.learned.checkpoints import SUFFIX
from agents.learned.coloured_noise import AutoregressiveNoise
from agents.names import SHIPPED_DRIVERS
from rare_envs.threads import use_one_thread
from training.command_line import report_errors, run_command
from training.data.trajectories import DT
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.behaviour import sampling_driver
from training.imitation.evaluation.driving_statistics import DrivingStatistics
from training.imitation.evaluation.realism import (
    Realism,
    collect_statistics,
    header_metrics,
    record_statistics,
    summarise_realism,
)
from training.imitation.traffic.recording import Recording, stack_scenes

HORIZONS = (10.0, 20.0)
"""Times for which scenes are driven [s]."""
DAMPINGS = (0.6, 0.4, 0.3)
"""Of the table, if none is named [1/s]."""


def load_learned_driver(spec: str) -> LearnedDriver:
    """Return a driver that has learned, by name or file.

    Raises:
        ValueError: There is none, or it is a rule.

    Example:
        >>> load_learned_driver("mgail").name
        'mgail'
        >>> load_learned_driver("idm")
        Traceback (most recent call last):
            ...
        ValueError: Expected a learned driver, got the rule 'idm'.
    """
    driver = load_driver(spec)
    if not isinstance(driver, LearnedDriver):
        raise ValueError(f"Expected a learned driver, got the rule {spec!r}.")
    return driver


def damp_acceleration(noise: AutoregressiveNoise, damping: float) -> AutoregressiveNoise:
    """Return a noise whose acceleration has another damping and the same natural frequency.

    Args:
        noise: Of an oscillator in its acceleration.
        damping: Rate of decay [1/s].

    Raises:
        ValueError: The acceleration does not oscillate, or would not with this damping.

    Example:
        >>> noise = AutoregressiveNoise.from_oscillators(frequency=(1.70, 1.57), damping=(0.845, 0.40))
        >>> [round(value, 4) for value in damp_acceleration(noise, 0.4).first]
        [1.8886, 1.8979]
    """
    (first, kept_first), (second, kept_second) = noise.first, noise.second
    radius = math.sqrt(max(-second, 0.0))
    if radius == 0.0 or abs(first) >= 2.0 * radius:
        raise ValueError(f"Expected noise of the acceleration that oscillates, got coefficients {first} and {second}.")
    natural = math.hypot(math.log(radius), math.acos(first / (2.0 * radius))) / DT
    if not 0.0 < damping < natural:
        raise ValueError(f"Expected a damping above 0 and below the natural frequency, {natural:.3g}, got {damping}.")
    frequency = math.sqrt(natural**2 - damping**2)
    made = AutoregressiveNoise.from_oscillators((frequency, 1.0), (damping, 1.0), dt=DT)
    return AutoregressiveNoise((made.first[0], kept_first), (made.second[0], kept_second))


def measure_driver(
    recording: Recording, recorded: DrivingStatistics, driver: LearnedDriver, seed: int = 0
) -> dict[float, Realism]:
    """Return how a driver does in recorded scenes, by horizon [s], with one sequence of noise.

    Args:
        recording: The scenes.
        recorded: Statistics of the people in them.
        driver: Driver of all vehicles.
        seed: Of its noise.
    """
    act = sampling_driver(driver, torch.Generator().manual_seed(seed))
    driven = collect_statistics(recording, act, HORIZONS)
    return {seconds: summarise_realism(each, recorded) for seconds, each in driven.items()}


def format_row(name: str, found: dict[float, Realism]) -> str:
    """Return one line of the table: rates at both horizons, and divergences and the error of position at the first."""
    both = [
        " / ".join(f"{getattr(each, rate):.4f}" for each in found.values())  # a field by its name
        for rate in ("collision", "off_road", "hard_brake", "lane_changes")
    ]
    first = found[HORIZONS[0]]
    far = [f"{first.divergence[quantity]:.4f}" for quantity in ("acceleration", "jerk", "yaw_rate", "inverse_ttc")]
    position = f"{first.rmse.get('position', math.nan):.2f}"
    return f"| {' | '.join([name, *both, *far, position])} |"


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    driver: Annotated[str, typer.Option(help="Name or file of a learned driver.")] = "mgail",
    damping: Annotated[list[float], typer.Option(help="In 1/s; may be repeated.")] = [*DAMPINGS],  # noqa: B006
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
    in_test: Annotated[bool, typer.Option("--test", help="Measure in the test scenes.")] = False,
    out: Annotated[Path | None, typer.Option(help="File for the driver with the last damping, .safetensors.")] = None,
) -> None:
    """Measure a driver with other dampings of its noise."""
    with report_errors("noise_damping"):
        first = load_learned_driver(driver)
        learn, test = (stack_scenes(scenes) for scenes in load_scenes(Source("data", data)))
        made = [replace(first, colour=damp_acceleration(first.colour, each)) for each in damping]
    scenes = test if in_test else learn
    recorded = record_statistics(scenes)
    print("| damping | collision 10 s / 20 s | off road | hard brake | lane changes per 10 s | ", end="")
    print("JS acceleration | jerk | yaw rate | inverse TTC | position after 5 s, m |")
    print("|" + "---|" * 10)
    for name, each in zip(("as it is", *(f"{value:g}" for value in damping)), (first, *made), strict=True):
        print(format_row(name, measure_driver(scenes, recorded, each, seed)), flush=True)
    if out is not None:
        print(f"Saved {write_damped(made[-1], driver, damping[-1], test, out)}.")


def write_damped(driver: LearnedDriver, of: str, damping: float, test: Recording, out: Path) -> Path:
    """Write a driver that differs from another in its noise, measured in the test scenes.

    Args:
        driver: The driver.
        of: Name or file of the other.
        damping: Of its acceleration's noise [1/s].
        test: Scenes that it has not learned from.
        out: File to write, .safetensors.

    Returns:
        The file.
    """
    return write_derived(replace(driver, name=out.stem), of, damping, "less damped noise", "noise_damping", test, out)


def write_derived(
    driver: LearnedDriver, of: str, damping: float | None, difference: str, module: str, test: Recording, out: Path
) -> Path:
    """Write a driver that was made of another without training, measured in the test scenes.

    Args:
        driver: The driver.
        of: Name or file of the other.
        damping: Of its acceleration's noise [1/s]; None where the command has no such option.
        difference: In words.
        module: Of this package, whose command makes it; its options without a value may follow.
        test: Scenes that it has not learned from.
        out: File to write, .safetensors.

    Returns:
        The file.
    """
    shipped = resources.files("agents") / "data" / f"{of}{SUFFIX}"
    with resources.as_file(shipped) if of in SHIPPED_DRIVERS else nullcontext(Path(of)) as path:
        before = read_provenance(path)
    option = "" if damping is None else f" --damping {damping:g}"
    command = f"python -m training.imitation.{module} data --driver {of}{option} --out OUT"
    provenance = replace(
        before,
        kind=f"{before.kind}, {difference}",
        command=f"{before.command}, then {command}",
        metrics=header_metrics(test, driver),
    )
    return save_driver(driver, provenance, out)


if __name__ == "__main__":
    run_command(main)
