"""Reproduction of O'Kelly et al. 2018: rollouts made, record and figures written."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.papers.okelly2018.figures import describe_figures, make_figures
from benchmarks.papers.okelly2018.printed import describe_printed
from benchmarks.papers.okelly2018.scales import CORE_SPEEDS, EGO_NAMES, STUDY_SCALES
from benchmarks.papers.okelly2018.study import HighwayStudy, measure_highway
from benchmarks.papers.okelly2018.summary import summarise_highway
from benchmarks.papers.okelly2018.tables import make_tables
from benchmarks.papers.record import check_reproduction_folder, make_record, write_record

SOURCE = (
    "O'Kelly, Sinha, Namkoong, Duchi and Tedrake, Scalable end-to-end autonomous vehicle testing via rare-event "
    "simulation, NeurIPS 2018: Tables 1 and 2, Figures 2 and 3, section 4."
)


def reproduce_okelly2018(
    study: HighwayStudy,
    out: Path,
    command: str,
    executor: Executor | None = None,
    limit: int | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Make the rollouts that a folder does not have yet, and write record and figures of what there is.

    Args:
        study: Ego, scale and seed.
        out: Folder of rollouts, record and figures.
        command: As typed.
        executor: Where rollouts are made; None for this process.
        limit: Rollouts to make now at most; the page says what is not run.
        progress: Whether to show bars.

    Raises:
        BadInput: The folder has rollouts of something else, or damaged ones.
    """
    check_reproduction_folder(out, study.identity)
    problem = study.make_problem()
    measured = measure_highway(study, out, problem, executor, limit, progress)
    record = make_okelly_record(study, command, summarise_highway(study, problem, measured))
    write_record(out, record, make_figures(record))
    return record


def make_okelly_record(study: HighwayStudy, command: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of a study.

    Args:
        study: What was measured.
        command: As typed.
        found: As `benchmarks.papers.okelly2018.summary.summarise_highway` returns it.
    """
    details = {name: value for name, value in found.items() if name != "findings"}
    return make_record(
        title=f"O'Kelly et al. 2018 with the {study.ego} ego, {study.scale} scale",
        source=SOURCE,
        command=command,
        settings={"ego": study.ego, "scale": study.scale, "seed": study.seed, "rollouts": asdict(study.settings)},
        tables=make_tables(study.ego, study.gammas, found),
        figures=describe_figures(study.ego, found),
        findings=found["findings"],
        notes=write_notes(study, found),
        runs=[{"printed": describe_printed(study.ego), **details}],
    )


def write_notes(study: HighwayStudy, found: Mapping[str, Any]) -> list[str]:
    """Return what holds for all of it, in sentences: the question, what was run, and what the rest would take."""
    ours = study.settings
    notes = [
        f"P[lidar_ttc <= gamma] on rare_envs/Highway-v0 with the ego `{EGO_NAMES[study.ego]}`: 428 dimensions, the "
        "drivers' noise one fixed sequence as in the released code, 10 s an episode. Every row is one run with "
        "one seed.",
        f"Made: {found['rollouts']:,} of {ours.rollouts - 4 * ours.own:,} rollouts of naive Monte Carlo and the "
        f"searches, and {len(found['own'])} of {4 if ours.own else 0} estimates by our default method.",
    ]
    if found["naive"]:
        events = ", ".join(str(row["events"]) for row in found["naive"])
        notes.append(
            f"The naive p rests on {events} events at the four thresholds; ratios to it are no surer than that."
        )
    made = found["rollouts"] + sum(own["n_sim"] for own in found["own"])
    if study.scale == "full" and made >= ours.rollouts:
        return notes
    speed, full = CORE_SPEEDS[study.ego], STUDY_SCALES[study.ego, "full"]
    numbers = (full.rollouts - made, full.rollouts, full.per_search, ours.rollouts)
    rest, whole, search, this = (n / speed / 3600.0 for n in numbers)
    if study.scale == "full":
        return [*notes, f"{_say_speed(speed)} the rest takes {rest:,.1f} hours; the same command goes on."]
    return [
        *notes,
        f"The full scale has {full.naive:,} naive rollouts and four searches of {full.per_search:,}, "
        f"{full.rollouts:,} with our own method. {_say_speed(speed)} that is {whole:,.1f} hours, "
        f"{search:,.1f} for each search, and {this:,.1f} for the small scale; "
        "`--scale full` goes on where it was stopped.",
    ]


def _say_speed(speed: float) -> str:
    """Return the beginning of a sentence: not the speed of this run, so that equal seeds give equal notes."""
    return f"At {speed:,.4g} rollouts a second, about what a core of an AMD EPYC makes by its processor time,"
