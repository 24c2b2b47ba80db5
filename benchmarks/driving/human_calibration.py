"""Does an attentive human driver collide as rarely as people do? Base distributions against the 100-Car study.

    python -m benchmarks.driving.human_calibration [--base CutIn=i80] [--draws 200000]

drives draws of each base distribution with the human driver model, with parts of it taken away, with `idm`, and with
one that brakes fully from the first moment on; counts contacts and near-crashes (`near_crash`); compares them with
people per event and per km; says what is off; and writes benchmarks/results/human_calibration.json and the end of
docs/human_driver.md. People's counts are those of `rare_envs.exposure.HUMAN_BENCHMARKS`, how often the events happen is
the `EventFrequency` of the base distribution.
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
from rare_envs.distributions import EventFrequency, FittedDistribution
from rare_envs.egos.human import HumanEgo
from rare_envs.exposure import (
    CUT_IN_CONTACTS_100CAR,
    CUT_IN_NEAR_CRASHES_100CAR,
    MILLION_KM,
    REAR_END_CONTACTS_100CAR,
    REAR_END_NEAR_CRASHES_100CAR,
    HumanBenchmark,
)
from rare_envs.measures import find_measure
from rare_envs.measures.longitudinal import MAX_BRAKING, RAPID_BRAKING
from rare_envs.measures.registry import Combined
from rare_envs.scenarios import load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.startup import use_one_thread
from samplers.sample import Interval, clopper_pearson

CALIBRATION_RESULT = RESULTS / "human_calibration.json"
PAGE, MEASURED = Path("docs/human_driver.md"), "## Measured"
CONFIDENCE = 0.95
CONTACT = -100.0
"""f of `near_crash` in a collision."""
SAFE, NEAR_CRASH, NEEDED, TOUCHED = 0.0, 1.0, 2.0, 3.0
"""Outcomes of a drive: nothing, a near-crash, one in which avoiding a contact took more than 0.5 g, a contact."""
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
    """Events of a kind, and what people's contacts and near-crashes in them are counted as."""

    env_id: str
    name: str
    contacts: HumanBenchmark
    near_crashes: HumanBenchmark

    def find_frequency(self, base: str | None) -> EventFrequency:
        """Return how often the events of a base distribution happen.

        Raises:
            ValueError: If nobody counted.
        """
        found = load_base(find_scenario(self.env_id), base)
        if not isinstance(found, FittedDistribution) or found.frequency is None:
            raise ValueError(f"The base {base!r} of {self.env_id} has no event frequency.")
        return found.frequency


EVENTS = (
    HumanEvents("rare_envs/CutIn-v1", "cut-in", CUT_IN_CONTACTS_100CAR, CUT_IN_NEAR_CRASHES_100CAR),
    # all of people's rear-end contacts are taken to begin with brakings of the base's kind, those to a standstill
    HumanEvents(
        "rare_envs/HardBrake-v0", "braking of the lead", REAR_END_CONTACTS_100CAR, REAR_END_NEAR_CRASHES_100CAR
    ),
)


def count_per_event(people: HumanBenchmark, frequency: EventFrequency) -> Interval:
    """Return how often people have such an outcome per event, with the exact interval of their count."""
    low, high = people.interval_per_million_km
    return low / MILLION_KM / frequency.per_km, high / MILLION_KM / frequency.per_km


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


def classify_outcomes(f: Tensor) -> Tensor:
    """Return the outcome of drives from f of `near_crash` and of `required_deceleration`, shapes (2, B) and (B,)."""
    near, required = f
    needed = required <= MAX_BRAKING - RAPID_BRAKING
    outcome = torch.where(near <= 0.0, torch.where(needed, NEEDED, NEAR_CRASH), SAFE)
    return torch.where(near <= CONTACT, TOUCHED, outcome)


OUTCOME = Combined((find_measure("near_crash"), find_measure("required_deceleration")), classify_outcomes)
"""Outcome of a drive as a measure; here large is dangerous."""


def count_outcomes(events: HumanEvents, driver: str, base: str, draws: int, seed: int = 0) -> CalibrationCell:
    """Drive draws of a base distribution once and count contacts and near-crashes."""
    problem = rare_envs.DrivingProblem(events.env_id, DRIVERS[driver], OUTCOME, base)
    rng = np.random.default_rng(seed)
    counts, flanks = np.zeros(4, dtype=np.int64), 0
    for size in split_draws(draws):
        x = problem.base.sample(size, rng)
        outcome = problem.evaluate(x)
        counts += np.bincount(outcome.astype(np.int64), minlength=4)
        hits = x[outcome == TOUCHED]
        flanks += problem.crash_kinds(hits).count("side") if len(hits) else 0
    _, near, needed, contacts = (int(each) for each in counts)
    return CalibrationCell(events.name, driver, base, draws, contacts, near + needed, needed, flanks)


def split_draws(draws: int, most: int = 20_000) -> list[int]:
    """Return sizes of parts that fit into memory."""
    return [min(most, draws - first) for first in range(0, draws, most)]


def judge(events: HumanEvents, frequency: EventFrequency, cells: Mapping[str, CalibrationCell]) -> list[str]:
    """Return sentences on what is off: the base distribution, the driver or the definition.

    Args:
        events: The kind of event.
        frequency: How often it happens.
        cells: Of each driver.
    """
    human, best = cells["human"], cells["full braking at once"]
    low, high = human.interval(human.contacts)
    least, most = count_per_event(events.contacts, frequency)
    rare = count_per_event(events.near_crashes, frequency)[1]
    told = [f"People: {least:.1e} to {most:.1e} contacts per {events.name}."]
    if low <= most and high >= least:
        return [*told, f"The human driver model agrees: {low:.1e} to {high:.1e}."]
    times = human.contacts / human.draws / most
    told.append(f"The human driver model: {low:.1e} to {high:.1e}, {times:.2g} times the upper end of people's.")
    floor, ceiling = best.interval(best.contacts + best.needed)
    rarely = f"people have near-crashes in up to {rare:.1e}"
    if floor > rare:
        told.append(
            f"Distribution: off. Whoever brakes fully at once still needs more than 0.5 g, or comes into contact, in "
            f"{floor:.1e} or more, and {rarely}: as they begin and are scripted, the events are too dangerous for "
            "any driver."
        )
    else:
        told.append(
            "Distribution: not shown to be off by itself. Whoever brakes fully at once needs more than 0.5 g, or comes "
            f"into contact, in {floor:.1e} to {ceiling:.1e}; {rarely}."
        )
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
        base = next(iter(own.values())).base
        frequency = events.find_frequency(base)
        lines += [f"### Per {events.name} (`{events.env_id}`, base `{base}`)", ""]
        lines += ["| driver | contacts | near-crashes | near-crashes that needed 0.5 g |", "|---|---|---|---|"]
        lines += [format_row(cell) for cell in own.values()]
        people = [count_per_event(each, frequency) for each in (events.contacts, events.near_crashes)]
        lines += [
            f"| people, 100-Car | {' | '.join(f'{low:.1e} to {high:.1e}' for low, high in people)} | |",
            "",
            *(f"* {each}" for each in judge(events, frequency, own)),
            "",
        ]
    return "\n".join([*lines, *format_per_km(cells)]) + "\n"


def format_row(cell: CalibrationCell) -> str:
    """Return one driver's row: probabilities per event, with intervals."""

    def share(count: int) -> str:
        low, high = cell.interval(count)
        return f"{count / cell.draws:.1e} ({low:.1e} to {high:.1e})" if count else f"under {high:.1e}"

    near = "" if cell.driver == "full braking at once" else share(cell.near_crashes)  # all are, by construction
    return f"| {cell.driver} | {share(cell.contacts)} | {near} | {share(cell.needed)} |"


def format_per_km(cells: Sequence[CalibrationCell]) -> list[str]:
    """Return the table of the human driver model, per million km."""
    lines = [
        "### Per million km",
        "",
        "| | events per km | contacts | people | near-crashes | people |",
        "|---|---|---|---|---|---|",
    ]
    for events in EVENTS:
        cell = next(cell for cell in cells if (cell.event, cell.driver) == (events.name, "human"))
        per_km = events.find_frequency(cell.base).per_km
        scale = MILLION_KM * per_km / cell.draws
        lines.append(
            f"| {events.name} | {per_km:.2f} "
            f"| {scale * cell.contacts:,.0f} | {events.contacts.per_million_km:.2g} "
            f"| {scale * cell.near_crashes:,.0f} | {events.near_crashes.per_million_km:.2g} |"
        )
    return lines


def describe_people(events: HumanEvents, frequency: EventFrequency) -> dict[str, Any]:
    """Return what the counts are compared with, for JSON."""
    return {
        "frequency": {**asdict(frequency), "per_km": frequency.per_km},
        "contacts": events.contacts.to_dict(),
        "contacts_per_event": count_per_event(events.contacts, frequency),
        "near_crashes": events.near_crashes.to_dict(),
        "near_crashes_per_event": count_per_event(events.near_crashes, frequency),
    }


def write_page(measured: str) -> None:
    """Put the measured part at the end of the page."""
    text = PAGE.read_text(encoding="utf-8").partition(MEASURED)[0]
    PAGE.write_text(text + measured, encoding="utf-8")


@use_one_thread()
def main(
    base: Annotated[
        list[str] | None, typer.Option(help="CutIn=NAME or HardBrake=NAME; the default of each scenario otherwise.")
    ] = None,
    draws: Annotated[int, typer.Option(help="Draws of each base distribution.")] = 200_000,
    seed: int = 0,
    page: Annotated[bool, typer.Option(help="Whether to write the JSON and the page.")] = True,
) -> None:
    """Measure, say what is off, and write the page."""
    chosen = dict(each.split("=", 1) for each in base or [])
    cells, people = [], {}
    for events in EVENTS:
        short = events.env_id.removeprefix("rare_envs/").rpartition("-v")[0]
        name = chosen.get(short, find_scenario(events.env_id).default_base)
        people[events.name] = describe_people(events, events.find_frequency(name))
        for driver in DRIVERS:
            cells.append(count_outcomes(events, driver, name, draws, seed))
            print(cells[-1], flush=True)
    command = "python -m benchmarks.driving.human_calibration" + "".join(f" --base {each}" for each in base or [])
    measured = format_measured(cells, command)
    print(measured)
    if page:
        about = {"command": command, "seed": seed, "version": rare_envs.__version__, "model": asdict(HUMAN)}
        content = {**about, "people": people, "cells": [asdict(cell) for cell in cells]}
        CALIBRATION_RESULT.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        write_page(measured)


if __name__ == "__main__":
    typer.run(main)
