"""Does an attentive human driver collide as rarely as people do? Base distributions against the 100-Car study.

    python -m benchmarks.driving.human_calibration [--base CutIn=us101-15-offsets] [--draws 50000]

drives draws of each base distribution with the human driver model, with parts of it taken away, with `idm`, and with
one that brakes fully from the first moment on; counts contacts and near-crashes (`near_crash`); compares them with
people per event and per km; says what is off; and writes benchmarks/results/human_calibration.json and the end of
docs/human_driver.md.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from torch import Tensor

import rare_envs
from benchmarks import RESULTS
from rare_envs.control.human_driver import MAX_HUMAN_BRAKING, HumanDriverModel
from rare_envs.egos.human import HumanEgo
from rare_envs.measures.braking import MAX_BRAKING, RAPID_BRAKING
from samplers.statistics.intervals import clopper_pearson

CALIBRATION_RESULT = RESULTS / "human_calibration.json"
PAGE, MEASURED = Path("docs/human_driver.md"), "## Measured"
CONFIDENCE = 0.95
CONTACT = -100.0
"""f of `near_crash` in a collision."""
HUMAN = HumanDriverModel()


class FullBraking:
    """An ego that brakes as hard as a human can from the first moment on: nobody can do more without steering."""

    def act(self, episode: Any, memory: Any) -> tuple[Tensor, Any]:
        """Return the hardest braking, straight ahead."""
        return torch.tensor([-MAX_HUMAN_BRAKING, 0.0]).expand(len(episode.collided), 2), memory


DRIVERS: Mapping[str, Any] = {
    "human": HumanEgo(HUMAN),
    "human without glances": HumanEgo(replace(HUMAN, glances=False)),
    "human without glances, reacting at once": HumanEgo(
        replace(HUMAN, glances=False, reaction_time=0.0, noticing_time=0.0)
    ),
    "idm": "idm",
    "full braking at once": FullBraking(),
}


@dataclass(frozen=True)
class HumanEvents:
    """Events of a kind, and how often people come into contact or near it in one."""

    env_id: str
    base: str
    """Base distribution, unless another is named."""
    name: str
    per_km: float
    """Events as the base defines them, per vehicle-km."""
    share: float
    """Share of the events that people are counted by which the base is about; the others count as safe."""
    contacts: tuple[float, float]
    """Contacts of people per event: what the 100-Car's exposure leaves open, for cut-ins with its Poisson interval."""
    near_crashes: tuple[float, float]
    """Near-crashes of people per event."""


EVENTS = (
    # 1 contact and 136 near-crashes begun by another's lane change in 3.22 million km, .13 to .31 cut-ins per km
    HumanEvents("rare_envs/CutIn-v0", "us101-15-offsets", "cut-in", 0.26, 1.0, (3e-8, 1.4e-5), (1.4e-4, 3.4e-4)),
    # 14 contacts and 385 near-crashes with a lead, .155 to 1.23 brakings of the lead per km; 42 of 268 to a standstill
    HumanEvents(
        env_id="rare_envs/HardBrake-v0",
        base="us101-all-brakings",
        name="braking of the lead",
        per_km=1.23,
        share=0.16,
        contacts=(3.5e-6, 2.8e-5),
        near_crashes=(9.7e-5, 7.7e-4),
    ),
)
PEOPLE_PER_KM = {"cut-in": (3.1e-7, 4.2e-5), "braking of the lead": (4.3e-6, 1.2e-4)}
"""Contacts and near-crashes of the 100-Car drivers per km, all roads: begun by another's lane change, and striking the
vehicle ahead."""


@dataclass(frozen=True)
class CalibrationCell:
    """One driver in one kind of event."""

    event: str
    driver: str
    base: str
    draws: int
    contacts: int
    near_crashes: int
    """Episodes with a rapid evasive manoeuvre and without contact."""
    needed: int
    """... of these, with a moment at which avoiding a contact takes more than 0.5 g."""
    flanks: int
    """Contacts of flank against flank."""

    def interval(self, count: int) -> tuple[float, float]:
        """Return the exact interval of the probability of what was counted."""
        return clopper_pearson(count, self.draws, CONFIDENCE)


def count_outcomes(events: HumanEvents, driver: str, base: str, draws: int, seed: int = 0) -> CalibrationCell:
    """Drive draws of a base distribution and count contacts and near-crashes."""
    f, flanks = {}, 0
    for measure in ("near_crash", "required_deceleration"):
        problem = rare_envs.DrivingProblem(events.env_id, DRIVERS[driver], measure, base)
        rng = np.random.default_rng(seed)
        parts = [problem.base.sample(size, rng) for size in split_draws(draws)]
        f[measure] = np.concatenate([problem.evaluate(x) for x in parts])
        if measure == "near_crash":
            hits = np.concatenate(parts)[f[measure] <= CONTACT]
            flanks = problem.crash_kinds(hits).count("side") if len(hits) else 0
    contact = f["near_crash"] <= CONTACT
    near = (f["near_crash"] <= 0.0) & ~contact
    needed = near & (f["required_deceleration"] <= MAX_BRAKING - RAPID_BRAKING)
    counts = (int(each.sum()) for each in (contact, near, needed))
    return CalibrationCell(events.name, driver, base, draws, *counts, flanks)


def split_draws(draws: int, most: int = 20_000) -> list[int]:
    """Return sizes of parts that fit into memory."""
    return [min(most, draws - first) for first in range(0, draws, most)]


def judge(events: HumanEvents, cells: Mapping[str, CalibrationCell]) -> list[str]:
    """Return sentences on what is off: the base distribution, the driver or the definition.

    Args:
        events: The kind of event.
        cells: Of each driver.
    """
    human, best = cells["human"], cells["full braking at once"]
    low, high = (share * events.share for share in human.interval(human.contacts))
    told = [f"People: {events.contacts[0]:.1e} to {events.contacts[1]:.1e} contacts per {events.name}."]
    if low <= events.contacts[1] and high >= events.contacts[0]:
        return [*told, f"The human driver model agrees: {low:.1e} to {high:.1e}."]
    times = human.contacts / human.draws * events.share / events.contacts[1]
    told.append(f"The human driver model: {low:.1e} to {high:.1e}, {times:.2g} times the upper end of people's.")
    floor = best.interval(best.contacts + best.needed)[0] * events.share
    rarely = f"people's {events.near_crashes[1]:.1e} near-crashes"
    if floor > events.near_crashes[1]:
        told.append(
            f"Distribution: off. Whoever brakes fully at once still needs more than 0.5 g, or comes into contact, in "
            f"{floor:.1e} or more, above {rarely}: as they begin and are scripted, the events are too dangerous for "
            "any driver."
        )
    else:
        told.append(f"Distribution: not shown to be off by itself: fully braked at once, {floor:.1e}, within {rarely}.")
    if human.flanks:
        told.append(
            f"Scenario: {human.flanks / human.contacts:.0%} of the contacts are flank against flank: the script of the "
            "cutter goes on with its lane change, and brakes for its own lead, whoever is beside it."
        )
    for part, driver, against in (
        ("glances", "human", "human without glances"),
        ("reaction and noticing", "human without glances", "human without glances, reacting at once"),
    ):
        told.append(f"Driver: {part} take contacts from {cells[against].contacts:,} to {cells[driver].contacts:,}.")
    if human.near_crashes:
        share, idm = human.needed / human.near_crashes, cells["idm"].near_crashes / cells["idm"].draws
        told.append(
            f"Definition: of the near-crashes {share:.0%} needed more than 0.5 g at some moment; the rest is braking "
            f"that the car-following model chooses and nobody needs (`idm`: {idm:.0%} of draws)."
        )
    return told


def format_measured(cells: Sequence[CalibrationCell], command: str) -> str:
    """Return the measured part of the page."""
    lines = [MEASURED, "", f"`{command}`; {cells[0].draws:,} draws each, intervals of 95 %.", ""]
    for events in EVENTS:
        own = {cell.driver: cell for cell in cells if cell.event == events.name}
        lines += [f"### Per {events.name} (`{events.env_id}`, base {next(iter(own.values())).base})", ""]
        if events.share != 1.0:
            lines += [f"A draw is one of the {events.share:.0%} to a standstill; the others are taken to be safe.", ""]
        lines += ["| driver | contacts | near-crashes | near-crashes that needed 0.5 g |", "|---|---|---|---|"]
        lines += [format_row(events, cell) for cell in own.values()]
        people = (f"{low:.1e} to {high:.1e}" for low, high in (events.contacts, events.near_crashes))
        lines += [
            f"| people, 100-Car | {' | '.join(people)} | |",
            "",
            *(f"* {each}" for each in judge(events, own)),
            "",
        ]
    return "\n".join([*lines, *format_per_km(cells)]) + "\n"


def format_row(events: HumanEvents, cell: CalibrationCell) -> str:
    """Return one driver's row: probabilities per event of the kind that people are counted by, with intervals."""

    def share(count: int) -> str:
        low, high = (end * events.share for end in cell.interval(count))
        if not count:
            return f"under {high:.1e}"
        return f"{count / cell.draws * events.share:.1e} ({low:.1e} to {high:.1e})"

    near = "" if cell.driver == "full braking at once" else share(cell.near_crashes)  # all are, by construction
    return f"| {cell.driver} | {share(cell.contacts)} | {near} | {share(cell.needed)} |"


def format_per_km(cells: Sequence[CalibrationCell]) -> list[str]:
    """Return the table per km of the human driver model."""
    lines = [
        "### Per km",
        "",
        "| | events per km | contacts | people | near-crashes | people |",
        "|---|---|---|---|---|---|",
    ]
    for events in EVENTS:
        cell = next(cell for cell in cells if (cell.event, cell.driver) == (events.name, "human"))
        rate = events.per_km * events.share / cell.draws
        contact, near = PEOPLE_PER_KM[events.name]
        lines.append(
            f"| {events.name} | {events.per_km * events.share:.2f} | {rate * cell.contacts:.1e} | {contact:.1e} "
            f"| {rate * cell.near_crashes:.1e} | {near:.1e} |"
        )
    return lines


def write_page(measured: str) -> None:
    """Put the measured part at the end of the page."""
    text = PAGE.read_text(encoding="utf-8").partition(MEASURED)[0]
    PAGE.write_text(text + measured, encoding="utf-8")


def main(
    base: Annotated[
        list[str] | None, typer.Option(help="CutIn=NAME or HardBrake=NAME; else those of `EVENTS`.")
    ] = None,
    draws: Annotated[int, typer.Option(help="Draws of each base distribution.")] = 50_000,
    seed: int = 0,
    page: Annotated[bool, typer.Option(help="Whether to write the JSON and the page.")] = True,
) -> None:
    """Measure, say what is off, and write the page."""
    torch.set_num_threads(1)
    chosen = dict(each.split("=", 1) for each in base or [])
    cells = []
    for events in EVENTS:
        name = chosen.get(events.env_id.removeprefix("rare_envs/").removesuffix("-v0"), events.base)
        for driver in DRIVERS:
            cells.append(count_outcomes(events, driver, name, draws, seed))
            print(cells[-1], flush=True)
    command = "python -m benchmarks.driving.human_calibration" + "".join(f" --base {each}" for each in base or [])
    measured = format_measured(cells, command)
    print(measured)
    if page:
        about = {"command": command, "seed": seed, "version": rare_envs.__version__, "model": asdict(HUMAN)}
        content = {**about, "cells": [asdict(cell) for cell in cells]}
        CALIBRATION_RESULT.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        write_page(measured)


if __name__ == "__main__":
    typer.run(main)
