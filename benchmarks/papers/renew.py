"""Rows of our own methods in the committed records of both papers, made anew; the paper's methods stay as they are.

The runs are written to a folder and those that are there are kept. The rows are what a whole reproduction gives at the
same seeds, without the hours of the other rows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import RESULTS
from benchmarks.papers.okelly2018.reproduction import compare_own, make_okelly_record
from benchmarks.papers.okelly2018.study import HighwayStudy, estimate_own
from benchmarks.papers.tian2024.figures import collect_figures
from benchmarks.papers.tian2024.replications import (
    FURTHER_COLUMNS,
    METHOD_ROWS,
    ROW_COLUMNS,
    RUN_COLUMNS,
    Run,
    row_of,
    run_replication,
)
from benchmarks.papers.tian2024.study import TianPlan, open_replications, record_replications
from benchmarks.samplers.runs import map_jobs
from rare_envs.files import format_json
from samplers.output import to_json_value

FURTHER = tuple(name for name, row in METHOD_ROWS.items() if not row.paper)
"""Methods of Tian et al.'s tables that their paper does not have."""
PAPERS = ("tian2024", "okelly2018", "okelly2018_full", "okelly2018_vision")
"""Committed records: the `reproduction.json` of a run."""
OWN_METHOD = "two-stage"
"""The default method, whose rows O'Kelly et al.'s tables have."""


def read_records() -> dict[str, dict[str, Any]]:
    """Return the committed records by paper."""
    return {paper: json.loads((RESULTS / f"{paper}.json").read_text(encoding="utf-8")) for paper in PAPERS}


def read_replications(record: dict[str, Any]) -> list[Run]:
    """Return the replications of a record of Tian et al., as far as it has them: no traces, no texts of warnings."""
    return [
        {
            **{name: group[name] for name in ROW_COLUMNS},
            **{name: math.nan if group[name][place] is None else group[name][place] for name in RUN_COLUMNS},
            **{name: [] for name in FURTHER_COLUMNS},
            "warnings": [""] * count,
        }
        for group in record["runs"]
        for place, count in enumerate(group["warnings"])
    ]


def renew_tian(record: dict[str, Any], folder: Path, methods: Sequence[str] = ()) -> dict[str, Any]:
    """Return a record with rows of further methods made anew; others take a whole run, as figures have traces."""
    for name in methods:
        if name not in FURTHER:
            raise ValueError(f"Expected methods of {', '.join(FURTHER)}, got {name!r}: run the whole reproduction.")
    about = record["about"]
    plan = TianPlan(about["replications"], int(about["seeds"].partition(" ")[0]))
    runs = read_replications(record)
    if methods:
        folder.mkdir(parents=True, exist_ok=True)
        jobs = [job for job in plan.jobs() if job.method in methods]
        lines = open_replications(folder, plan)
        made = lines.complete(jobs, lambda missing: map_jobs(run_replication, missing), True, "replications")
        new = {(*row_of(run), run["seed"]): run for run in made}
        runs = [new.get((*row_of(run), run["seed"]), run) for run in runs]
    anew = record_replications(plan, runs, record["command"])
    figures = {**record["figures"]}
    figures["figure8"] = {**figures["figure8"], "ends": to_json_value(collect_figures(runs))["figure8"]["ends"]}
    # what rests on the traces of the paper's methods stays
    return {**anew, "about": about, "figures": figures, "findings": record["findings"]}


def renew_okelly(record: dict[str, Any], folder: Path, own: bool = True) -> dict[str, Any]:
    """Return a record with the rows of our default method made anew."""
    about, (details,) = record["about"], record["runs"]
    study = HighwayStudy(about["ego"], about["scale"], about["seed"])
    found = {**details, "findings": []}
    if own and details["own"]:
        folder.mkdir(parents=True, exist_ok=True)
        made = estimate_own(study, folder, study.make_problem(), [each["gamma"] for each in details["own"]], True)
        found["own"] = [compare_own(each, details["naive"]) for each in made]
    anew = make_okelly_record(study, record["command"], found)
    return {**anew, "about": about, "findings": record["findings"]}


def renew(folder: Path, papers: Sequence[str] = PAPERS, methods: Sequence[str] = (OWN_METHOD,)) -> None:
    """Put rows of our own methods, made anew, into committed records."""
    for paper, record in read_records().items():
        if paper not in papers:
            continue
        if paper == "tian2024":
            anew = renew_tian(record, folder / paper, methods)
        else:
            anew = renew_okelly(record, folder / paper, OWN_METHOD in methods)
        (RESULTS / f"{paper}.json").write_text(format_json(anew) + "\n", encoding="utf-8")
