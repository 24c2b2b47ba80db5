"""A driver with a rule of collision avoidance: the same weights, less damped noise, and bounds of the actions.

    python -m training.imitation.collision_avoidance DATA --out mgail2.safetensors [--driver mgail] [--damping 0.4]

Nothing is trained. The settings of the rule are those of `agents.learned.collision_avoidance`, chosen in
the scenes that mgail learned from and on rings.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from agents import LearnedDriver
from agents.learned.collision_avoidance import CollisionAvoidance
from rare_envs.threads import use_one_thread
from training.command_line import report_errors, run_command
from training.imitation.datasets import Source, load_scenes
from training.imitation.noise_damping import damp_acceleration, load_learned_driver, write_derived
from training.imitation.traffic.recording import Recording, stack_scenes


def add_avoidance(driver: LearnedDriver, damping: float, name: str) -> LearnedDriver:
    """Return a driver with the rule's default settings, another damping [1/s] of its noise and another name."""
    colour = damp_acceleration(driver.colour, damping)
    return replace(driver, colour=colour, avoidance=CollisionAvoidance(), name=name)


def write_driver(of: str, damping: float, test: Recording, out: Path) -> Path:
    """Write a driver with the rule, measured in the test scenes.

    Args:
        of: Name or file of the driver without it.
        damping: Of the acceleration's noise [1/s].
        test: Scenes that it has not learned from.
        out: File to write, .safetensors.

    Raises:
        ValueError: The driver is a rule.
    """
    made = add_avoidance(load_learned_driver(of), damping, out.stem)
    return write_derived(made, of, damping, "rule of collision avoidance", "collision_avoidance", test, out)


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    out: Annotated[Path, typer.Option(help="File to write, .safetensors.")],
    driver: Annotated[str, typer.Option(help="Name or file of a learned driver.")] = "mgail",
    damping: Annotated[float, typer.Option(help="Of the acceleration's noise [1/s].")] = 0.4,
) -> None:
    """Write a driver with a rule of collision avoidance."""
    with report_errors("collision_avoidance"):
        test = stack_scenes(load_scenes(Source("data", data))[1])
        print(f"Saved {write_driver(driver, damping, test, out)}.")


if __name__ == "__main__":
    run_command(main)
