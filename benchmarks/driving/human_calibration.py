"""Do simulated people crash and nearly crash as often as people do? Per kind of event, against the 100-Car study.

    python -m benchmarks.driving.human_calibration [--draws 1000000] [--workers 2] [--ego ppo.zip]

drives draws of each stratum (cutters who looked, cutters who did not, leads that stop, leads that slow) with the human
driver model with and without its headway rule, the IDM and the shipped egos, and counts contacts and near-crashes
(`near_crash`); takes away parts of the model one at a time; compares per event and per million km with people's counts
by precipitating event (`rare_envs.people.people_in`); and says which targets are met. It writes
benchmarks/results/human_calibration.json, rare_envs/data/human_calibration.json (what the package prints beside rates)
and the end of docs/human_driver.md; with --no-drive from the cells of the last run, with --stratum from these but for
those of one stratum.

People's counts are those of all roads; how often the events happen is the `EventFrequency` of the base distribution. No
constant of the model or of the scenarios may be changed because of what is printed here without saying so on the page.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from torch import Tensor

import rare_envs
import rare_envs.people
from agents import load_ego
from benchmarks import RESULTS
from rare_envs.control.human_driver import ATTENTIVE_IDM
from rare_envs.distributions.events import EventFrequency
from rare_envs.egos.human import HUMAN_EGOS, HumanEgo
from rare_envs.exposure import MILLION_KM
from rare_envs.measures.registry import NearCrash, NearCrashState
from rare_envs.people import Event, EventCalibration, ModelCount, Outcome, people_in
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.cut_in import CutterModel
from rare_envs.scenarios.registry import SCENARIOS, find_scenario
from samplers.sample import clopper_pearson

CALIBRATION_RESULT = RESULTS / "human_calibration.json"
CALIBRATION_OF_PACKAGE = Path(rare_envs.people.__file__).parent / "data" / "human_calibration.json"
PAGE, MEASURED = Path("docs/human_driver.md"), "## Measured"
CONFIDENCE = 0.95
CUT_IN, HARD_BRAKE = "rare_envs/CutIn-v1", "rare_envs/HardBrake-v0"
HUMAN, NO_HEADWAY_RULE = "human", "human:no-headway-rule"


class Stratum(NamedTuple):
    """Events of one kind, a stratum of a base distribution."""

    env_id: str
    event: Event
    words: str
    share: float
    """Of the draws that are asked for, what it gets: where contacts are one in a hundred, fewer do; where people had
    none in 3 million events, more must be without one. Changes of parts, and networks, get at most all."""


STRATA: Mapping[str, Stratum] = {
    "looked": Stratum(CUT_IN, "cut_in", "cutters who looked", 1.0),
    "unseen": Stratum(CUT_IN, "cut_in", "cutters who had not looked", 0.1),
    "stop": Stratum(HARD_BRAKE, "stop", "leads that stop", 1.0),
    "slowing": Stratum(HARD_BRAKE, "slowing", "leads that slow", 4.0),
}
EVENT_WORDS: Mapping[Event, str] = {"cut_in": "cut-in", "stop": "lead that stops", "slowing": "lead that slows"}
OUTCOMES: tuple[Outcome, Outcome] = ("contacts", "near_crashes")
WITHIN: Mapping[Event, float] = {"cut_in": 3.0, "stop": 3.0, "slowing": 5.0}
"""Factors within which `human` has to meet people's intervals."""


class Change(NamedTuple):
    """One part of the driver, of the cutter or of the base taken away or changed, all else as it is."""

    strata: tuple[str, ...]
    """Where it matters."""
    driver: Mapping[str, Any] = {}
    """Fields of `HumanDriverModel`."""
    cutter: Mapping[str, Any] = {}
    """Fields of `CutterModel`."""
    base: str = ""
    """Ending of the base distribution's name."""


_CUT_INS, _BRAKES = ("looked", "unseen"), ("stop", "slowing")
CHANGES: Mapping[str, Change] = {
    "": Change(tuple(STRATA)),
    "no glances": Change(("looked", *_BRAKES), {"glances": False}),
    "no headway rule for glances": Change(("looked", *_BRAKES), {"headway_rule": False}),
    "glances not broken off by looming": Change(_BRAKES, {"glance_eccentricity": 180.0}),
    "glances begun even while closing": Change(_BRAKES, {"glance_looming": math.inf}),
    "no headway rule, glances not broken off": Change(_BRAKES, {"headway_rule": False, "glance_eccentricity": 180.0}),
    "no constant-acceleration heuristic": Change(("looked", *_BRAKES), {"coolness": 0.0}),
    "the heuristic behind brake lights too": Change(_BRAKES, {"brake_light": math.inf}),
    "no evasive steering": Change(_CUT_INS, {"evasive_share": 0.0}),
    "indicators not noticed": Change(("looked",), {"notice_indicator": False}),
    "every change indicated": Change(("looked",), {}, {"indicating": 1.0}),
    "the cutter never looks": Change(("looked",), {}, {"looks": False}),
    "it turns back above 4 m/s^2, not 2": Change(("looked",), {}, {"most_braking": 4.0}),
    "the cutter follows its lead by IDM": Change(("looked",), {}, {"coolness": None}),
    "it wants no more than its initial speed": Change(_CUT_INS, {}, {"idm": replace(ATTENTIVE_IDM, desired_speed=1.0)}),
    "the lead keeps its speed": Change(("looked",), {}, {"brakings_per_km": 0.0}),
    "gaps that nobody accepts": Change(("looked",), {}, {}, "-test"),
    "gaps that nobody accepts, never looks": Change(("looked",), {}, {"looks": False}, "-test"),
    "noticed after 0.01 s": Change(("unseen",), {}, {"noticing": 0.01}),
    "noticed after 0.25 s": Change(("unseen",), {}, {"noticing": 0.25}),
    "noticed after 1 s": Change(("unseen",), {}, {"noticing": 1.0}),
    "never noticed": Change(("unseen",), {}, {"oblivious": 1.0}),
}
"""Parts by name; "" is the model as it is. Of a change other than it, `CHANGED_SHARE` of the draws are driven."""
CHANGED_SHARE = 0.2
EGOS: Mapping[str, float] = {HUMAN: 1.0, NO_HEADWAY_RULE: 1.0, "idm": 1.0, "imitation": 0.03}
"""Egos, and their share of the draws: networks are slow, and `vision`, a quarter of a second a drive, is too slow for
counts like these. Those that get less than all of them are driven at the first site alone."""
OWN_EGO_SHARE = 0.02
CHUNK = 20_000


class Drawn(NamedTuple):
    """What is driven: draws of one stratum of a site, with one ego and one change."""

    site: str
    stratum: str
    ego: str
    change: str = ""


class Job(NamedTuple):
    """A part of the draws of a cell, which is the same whoever drives it."""

    drawn: Drawn
    part: int
    size: int
    seed: int


NOTHING, RAPID, COUNTER, EVADED, CONTACT = range(5)
"""Outcomes: nothing rapid; a rapid manoeuvre that nobody needed; a near-crash, since without it there is a contact; a
near-crash, since a cutter that had not looked turns back; a contact."""


class OutcomeMeasure(NearCrash):
    """The outcome of a drive as f: large is dangerous here."""

    def f(self, state: NearCrashState) -> Tensor:
        """Return the outcome, shape (B,)."""
        outcome = torch.where(state.rapid >= 1.0, float(RAPID), float(NOTHING))
        outcome = torch.where(state.ttc <= 0.0, float(COUNTER), outcome)
        return torch.where(state.collided, float(CONTACT), torch.where(state.evaded, float(EVADED), outcome))


@dataclass(frozen=True)
class CalibrationCell:
    """Outcomes of the draws of one stratum with one ego and one change."""

    site: str
    stratum: str
    ego: str
    change: str
    draws: int
    rapid: int
    """Rapid manoeuvres that nobody needed."""
    counter: int
    """Near-crashes: without the ego's rapid manoeuvre there is a contact."""
    evaded: int
    """Near-crashes: the cutter, which had not looked, turns back."""
    contacts: int
    flanks: int
    """Contacts of flank against flank."""

    @property
    def near_crashes(self) -> int:
        """Near-crashes of either kind."""
        return self.counter + self.evaded

    def probability(self, outcome: Outcome) -> ModelCount:
        """Return the probability of contacts or near-crashes with its exact interval."""
        count = getattr(self, outcome)
        return ModelCount(count / self.draws, *clopper_pearson(count, self.draws, CONFIDENCE))


@cache
def make_problem(drawn: Drawn) -> rare_envs.DrivingProblem:
    """Return the problem whose f is the outcome."""
    change, env_id = CHANGES[drawn.change], STRATA[drawn.stratum].env_id
    if change.cutter:
        env_id = f"calibration/{list(CHANGES).index(drawn.change)}"
        SCENARIOS.setdefault(env_id, CutterModel(**change.cutter).scenario())
    ego: Any = drawn.ego if drawn.ego in EGOS else load_ego(drawn.ego)
    if change.driver:
        ego = HumanEgo(replace(HUMAN_EGOS[drawn.ego].model, **change.driver))
    return rare_envs.DrivingProblem(env_id, ego, OutcomeMeasure(), drawn.site + change.base)


def find_stratum(base: Any, name: str) -> Any:
    """Return a stratum of a base distribution; the distribution itself where it has none, as test distributions."""
    strata = {each.name: each.base for each in getattr(base, "strata", None) or ()}
    return strata[name] if strata else base


def run(job: Job) -> Counter[int]:
    """Return how often each outcome happened; flanks are counted as number -1."""
    torch.set_num_threads(1)
    problem = make_problem(job.drawn)
    number = list(STRATA).index(job.drawn.stratum)  # changes and egos share their draws
    base = find_stratum(problem.base, job.drawn.stratum)
    x = base.sample(job.size, np.random.default_rng([job.seed, number, job.part]))
    outcome = problem.evaluate(x).astype(np.int64)
    hits = x[outcome == CONTACT]
    flanks = problem.crash_kinds(hits).count("side") if len(hits) else 0
    return Counter(outcome.tolist()) + Counter({-1: flanks})


def list_jobs(drawn: Iterable[tuple[Drawn, int]], seed: int) -> Iterator[Job]:
    """Yield the draws of each cell part by part."""
    for what, draws in drawn:
        for part, first in enumerate(range(0, draws, CHUNK)):
            yield Job(what, part, min(CHUNK, draws - first), seed)


def count(drawn: Sequence[tuple[Drawn, int]], seed: int, workers: int) -> Iterator[CalibrationCell]:
    """Drive all draws, by processes, and yield the cells as they are done."""
    jobs = list(list_jobs(drawn, seed))
    with ProcessPoolExecutor(workers, get_context("spawn")) as executor:
        counted = executor.map(run, jobs) if workers > 1 else map(run, jobs)
        sums: dict[Drawn, Counter[int]] = {}
        left = Counter(job.drawn for job in jobs)
        for job, found in zip(jobs, counted, strict=True):
            of = sums.setdefault(job.drawn, Counter())
            of.update(found)
            left[job.drawn] -= 1
            if not left[job.drawn]:
                draws = sum(of[outcome] for outcome in range(5))
                yield CalibrationCell(*job.drawn, draws, of[RAPID], of[COUNTER], of[EVADED], of[CONTACT], of[-1])


def plan(sites: Sequence[str], draws: int, egos: Sequence[str], changes: bool = True) -> list[tuple[Drawn, int]]:
    """Return the cells and their numbers of draws, those of `human` first."""
    found: dict[Drawn, int] = {}
    for site in sites:
        here = {name: each for name, each in STRATA.items() if site in find_scenario(each.env_id).bases}
        for ego in egos:
            share = EGOS.get(ego, OWN_EGO_SHARE)
            if share < 1.0 and site != sites[0]:
                continue
            most = math.inf if share == 1.0 else 1.0
            found |= {
                Drawn(site, name, ego): round(draws * share * min(each.share, most)) for name, each in here.items()
            }
        first = site == sites[0]
        for name, change in CHANGES.items() if changes and first else ():
            of = {Drawn(site, each, HUMAN, name): STRATA[each].share for each in change.strata if name and each in here}
            found |= {what: round(draws * CHANGED_SHARE * min(max(share, 0.25), 1.0)) for what, share in of.items()}
    return [(what, max(number, 100)) for what, number in found.items()]


# --- sums over strata, and people ---------------------------------------------------------------


def add(parts: Sequence[tuple[float, ModelCount]]) -> ModelCount:
    """Return the sum of share x probability; its interval adds up squares of distances (Zou and Donner, 2008)."""
    p = sum(share * each.p for share, each in parts)
    below, above = (math.hypot(*(share * (each[end] - each.p) for share, each in parts)) for end in (1, 2))
    return ModelCount(p, max(p - below, 0.0), p + above)


def find_events(site: str) -> dict[Event, tuple[float, dict[str, float]]]:
    """Return of each kind of event at a site how often it happens per km, and its strata with their shares."""
    found: dict[Event, tuple[float, dict[str, float]]] = {}
    for env_id in (CUT_IN, HARD_BRAKE):
        scenario = find_scenario(env_id)
        if site not in scenario.bases:
            continue
        base: Any = load_base(scenario, site)
        frequency: EventFrequency = base.frequency
        for each in base.strata:
            event = STRATA[each.name].event
            if env_id == CUT_IN:
                found.setdefault(event, (frequency.per_km, {}))[1][each.name] = each.share
            else:  # each stratum is an event of its own
                found[event] = (frequency.per_km * each.share, {each.name: 1.0})
    return {event: found[event] for event in EVENT_WORDS if event in found}


def calibrate(cells: Sequence[CalibrationCell], site: str) -> dict[Event, EventCalibration]:
    """Return contacts and near-crashes of each ego per event, and people's, of the cells without changes."""
    found: dict[Event, EventCalibration] = {}
    for event, (per_km, shares) in find_events(site).items():
        drivers: dict[str, dict[str, ModelCount]] = {}
        for ego in dict.fromkeys(cell.ego for cell in cells):
            own = {c.stratum: c for c in cells if (c.site, c.ego, c.change) == (site, ego, "") and c.stratum in shares}
            if set(own) == set(shares):
                drivers[ego] = {
                    outcome: add([(w, own[name].probability(outcome)) for name, w in shares.items()])
                    for outcome in OUTCOMES
                }
        found[event] = EventCalibration(event=event, base=site, per_km=per_km, drivers=drivers)
    return found


def to_package(cells: Sequence[CalibrationCell], sites: Sequence[str], command: str) -> dict[str, Any]:
    """Return what `rare_envs.people.calibration` reads, by event and base: the human drivers alone."""
    events: dict[Event, dict[str, Any]] = {event: {} for event in EVENT_WORDS}
    for site in sites:
        for event, each in calibrate(cells, site).items():
            counts = {
                ego: {outcome: [float(f"{value:.3g}") for value in of] for outcome, of in each.drivers[ego].items()}
                for ego in (HUMAN, NO_HEADWAY_RULE)
            }
            events[event][site] = {"per_km": each.per_km, "drivers": counts}
    return {"command": command, "events": events}


# --- the page -----------------------------------------------------------------------------------


def show(p: ModelCount, scale: float = 1.0, digits: str = ".1e") -> str:
    """Return a probability, or a rate by its scale, with its interval."""
    low, high = scale * p.low, scale * p.high
    return f"{scale * p.p:{digits}} [{low:{digits}},{high:{digits}}]" if p.p > 0 else f"<{high:{digits}}"


def format_events(found: Mapping[Event, EventCalibration], site: str) -> list[str]:
    """Return the tables of egos and people, per event and per million km.

    Egos are left out who had nothing, and whose draws are too few to tell them from people; a line names them.
    """
    lines = [f"### {site}", ""]
    for event, each in found.items():
        scale = MILLION_KM * each.per_km
        lines += [
            f"Per {EVENT_WORDS[event]}, {each.per_km:.2f} of them per km, and per million km:",
            "",
            "| | contacts | near-crashes | contacts per million km | near-crashes per million km |",
            "|---|---|---|---|---|",
        ]
        ends = {outcome: each.people(outcome) for outcome in OUTCOMES}
        people: dict[str, ModelCount] = {outcome: ModelCount(p, *interval) for outcome, (p, interval) in ends.items()}
        vague = []
        for ego, of in {**each.drivers, "**people**": people}.items():
            if any(of[outcome].p > 0 or of[outcome].high < people["near_crashes"].low for outcome in OUTCOMES):
                values = [show(of[outcome]) for outcome in OUTCOMES]
                values += [show(of[outcome], scale, ".2g") for outcome in OUTCOMES]
                lines.append(f"| {ego} | {' | '.join(values)} |")
            else:
                vague.append(f"{ego} had none, but too few draws: {show(of['contacts'])}")
        lines += ["", *(f"{'; '.join(vague)}.\n" for _ in vague[:1])]
    return lines


def format_changes(cells: Sequence[CalibrationCell], title: str) -> list[str]:
    """Return the table of contacts / near-crashes, with their intervals, by part taken away and stratum."""
    lines = [title, "", f"| contacts, near-crashes | {' | '.join(each.words for each in STRATA.values())} |"]
    lines.append("|---" * (len(STRATA) + 1) + "|")
    found: dict[str, dict[str, str]] = {}
    for cell in cells:
        text = "<br>".join(show(cell.probability(outcome)).replace(" ", "") for outcome in OUTCOMES)
        found.setdefault(cell.change, {})[cell.stratum] = text
    for change, texts in found.items():
        lines.append(f"| {change or 'as it is'} | {' | '.join(texts.get(name, '') for name in STRATA)} |")
    return [*lines, ""]


def judge(found: Mapping[Event, EventCalibration]) -> list[str]:
    """Return a sentence on `human` for each target."""
    told = []
    for event, each in found.items():
        for outcome in OUTCOMES:
            factor, within = each.factor(outcome), WITHIN[event]
            met = "met" if 1.0 / within <= factor <= within else "MISSED"
            told.append(
                f"{outcome.replace('_', '-')} per {EVENT_WORDS[event]}, within {within:g}: **{met}**, "
                f"{each.describe_factor(outcome)}."
            )
    return told


def judge_cutters(cells: Sequence[CalibrationCell], site: str) -> list[str]:
    """Return what the strata of cut-ins say by themselves, with `human`: contacts, share and types of near-crashes."""
    of = {c.stratum: c for c in cells if (c.site, c.ego, c.change) == (site, HUMAN, "")}
    if "unseen" not in of:
        return []
    (per_km, shares), unseen = find_events(site)["cut_in"], of["unseen"]
    low, high = clopper_pearson(unseen.contacts, max(unseen.contacts + unseen.near_crashes, 1), CONFIDENCE)
    near, own_changes = unseen.probability("near_crashes").p, rare_envs.people.UNSEEN_CHANGES_100CAR
    share = own_changes.per_million_km / MILLION_KM / per_km / near if near > 0 else math.nan
    events = people_in("cut_in").near_crashes.miles * rare_envs.people.KM_PER_MILE * per_km
    own, theirs = (
        events * sum(w * getattr(of[name], kind) / of[name].draws for name, w in shares.items())
        for kind in ("counter", "evaded")
    )
    return [
        f"Contacts among the conflicts with cutters who had not looked: {low:.1%} to {high:.1%}; people none of 44 "
        "own and none of 58 sideswipe conflicts, under 3.6 %.",
        f"P(near-crash | not looked) is {near:.3f}, which gives a share of {share:.2e} (traffic model: "
        f"{shares['unseen']:.2e}).",
        f"By type, in the 100-Car's distance: {own:.0f} near-crashes at cut-ins that the ego avoids (people: 74 "
        f"rear-end), {theirs:.0f} that the cutter avoids (people: 58 sideswipe).",
    ]


def format_measured(cells: Sequence[CalibrationCell], sites: Sequence[str], command: str) -> str:
    """Return the measured part of the page."""
    lines = [
        f"{MEASURED}\n",
        f"`{command}`; 95 % intervals cover sampling and people's counts only: the share of cutters who had not looked "
        "and the frequencies of events are taken as exact. `vision` is too slow to count ([results](results.md)).\n",
        *format_events(calibrate(cells, sites[0]), sites[0]),
        "### Targets\n",
    ]
    lines += [f"* {each}" for each in (*judge(calibrate(cells, sites[0])), *judge_cutters(cells, sites[0]))]
    for site in sites[1:]:
        lines += [f"* At {site}: {each}" for each in judge(calibrate(cells, site))]
    of_human = [c for c in cells if (c.site, c.ego) == (sites[0], HUMAN)]
    lines += ["", *format_changes(of_human, f"### Effect of each part, `human` on {sites[0]}")]
    return "\n".join(lines).rstrip() + "\n"


def write_page(measured: str) -> None:
    """Put the measured part at the end of the page."""
    text = PAGE.read_text(encoding="utf-8").partition(MEASURED)[0]
    PAGE.write_text(text + measured, encoding="utf-8")


def main(
    draws: Annotated[int, typer.Option(help="Draws of `human` where contacts are rarest.")] = 1_000_000,
    site: Annotated[list[str] | None, typer.Option(help="Site; the first one's changes are driven too.")] = None,
    ego: Annotated[list[str] | None, typer.Option(help="These egos and not the shipped ones, such as ppo.zip.")] = None,
    stratum: Annotated[list[str] | None, typer.Option(help="These alone; of others the last run's cells stay.")] = None,
    changes: Annotated[bool, typer.Option(help="Whether to take parts away.")] = True,
    workers: int = 2,
    seed: int = 0,
    drive: Annotated[bool, typer.Option(help="Whether to drive; the cells of the last run are taken else.")] = True,
    write: Annotated[bool, typer.Option(help="Whether to write both files and the page.")] = True,
) -> None:
    """Measure, compare with people, and write."""
    sites, egos = site or ["us101", "i80"], ego or list(EGOS)
    options = {"draws": [str(draws)], "site": site or [], "ego": ego or [], "seed": [str(seed)]}
    given = "".join(f" --{name} {value}" for name, values in options.items() for value in values)
    command = f"python -m benchmarks.driving.human_calibration{given}"
    about: dict[str, Any] = {"command": command, "version": rare_envs.__version__}
    about |= {"model": asdict(HUMAN_EGOS[HUMAN].model), "verdicts": [], "cells": []}
    if stratum or not drive:
        about = json.loads(CALIBRATION_RESULT.read_text(encoding="utf-8"))
        command = about["command"]
    known = {Drawn(*list(each.values())[:4]): CalibrationCell(**each) for each in about["cells"]}
    planned = [each for each in plan(sites, draws, egos, changes) if not stratum or each[0].stratum in stratum]
    for cell in count(planned, seed, workers) if drive else ():
        known[Drawn(cell.site, cell.stratum, cell.ego, cell.change)] = cell
        print(cell, flush=True)
    cells = list(known.values())
    measured = format_measured(cells, sites, command)
    print(measured)
    if write:
        verdicts = [*judge(calibrate(cells, sites[0])), *judge_cutters(cells, sites[0])]
        told = {"verdicts": verdicts, "cells": [asdict(c) for c in cells]}
        CALIBRATION_RESULT.write_text(json.dumps({**about, **told}, indent=1) + "\n", encoding="utf-8")
        package = json.dumps(to_package(cells, sites, command), indent=1)
        CALIBRATION_OF_PACKAGE.write_text(package + "\n", encoding="utf-8")
        write_page(measured)


if __name__ == "__main__":
    typer.run(main)
