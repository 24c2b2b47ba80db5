"""The reproduction in a folder: replications as lines of a file, then record and page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rare_envs
from benchmarks.papers.record import check_folder, make_record, write_record
from benchmarks.papers.tian2024.figures import collect_figures, draw_figures
from benchmarks.papers.tian2024.printed import TIAN_SOURCE
from benchmarks.papers.tian2024.replications import (
    ADSS_SIMULATIONS,
    EPISODE_SECONDS,
    FIGURE7_METHOD,
    METHOD_ROWS,
    POINTS_OF_A_LEVEL,
    ROW_COLUMNS,
    RUN_COLUMNS,
    SCENARIO_ROWS,
    SYSTEMS,
    TRAFFIC_BASE,
    Key,
    ReplicationJob,
    Run,
    read_run,
    row_of,
    run_replication,
)
from benchmarks.papers.tian2024.summary import assess_claims, make_method_tables
from benchmarks.run_lines import RunLines
from benchmarks.samplers.runs import map_jobs

REPLICATIONS_FILE = "runs.jsonl"
SCALES = {"small": 5, "full": 20}
"""Replications by scale; the paper has 20."""


@dataclass(frozen=True)
class TianPlan:
    """What is to be run."""

    replications: int = SCALES["full"]
    seed: int = 0
    """Of the first replication; the others have the seeds that follow."""

    def __post_init__(self) -> None:
        if self.replications < 2:
            raise ValueError(f"Expected 2 replications at least, for a spread, got {self.replications}.")
        if self.seed < 0:
            raise ValueError(f"Expected a seed of at least 0, got {self.seed}.")

    @property
    def identity(self) -> dict[str, Any]:
        """What tells reproductions apart."""
        return {"paper": "tian2024", "replications": self.replications, "seed": self.seed}

    def jobs(self) -> list[ReplicationJob]:
        """Return the replications: the paper's methods, then further ones, Monte Carlo at the end."""
        own = [name for name, row in METHOD_ROWS.items() if row.paper and name != "MC"]
        further = [name for name, row in METHOD_ROWS.items() if not row.paper]
        return [
            ReplicationJob(
                scenario, system, method, self.seed + k, points=method == FIGURE7_METHOD and scenario == "cut-in"
            )
            for methods in (own, further, ["MC"])
            for k in range(self.replications)
            for scenario in SCENARIO_ROWS
            for system in SYSTEMS
            for method in methods
        ]


def reproduce_tian2024(
    plan: TianPlan, out: Path, command: str, workers: int = 1, progress: bool = False
) -> dict[str, Any]:
    """Make the replications that a folder lacks, write record and figures; BadInput if it has other ones."""
    check_folder(out, plan.identity)
    out.mkdir(parents=True, exist_ok=True)
    lines = open_replications(out, plan)
    runs = lines.complete(
        plan.jobs(), lambda missing: map_jobs(run_replication, missing, workers), progress, "replications"
    )
    record = record_replications(plan, runs, command)
    write_record(out, record, draw_figures(record["figures"]))
    return record


def open_replications(out: Path, plan: TianPlan) -> RunLines[ReplicationJob, Run]:
    """Return the replications of a folder."""
    return RunLines(
        out / REPLICATIONS_FILE,
        {"study": plan.identity, "rare_envs": rare_envs.__version__},
        read_run,
        dict,
        key_of_job=lambda job: job[:4],
        key_of_run=lambda run: (*row_of(run), run["seed"]),
    )


def record_replications(plan: TianPlan, runs: Sequence[Run], command: str) -> dict[str, Any]:
    """Return the record of some replications."""
    return make_record(
        title="Tian et al. 2024: adaptive subset simulation",
        source=TIAN_SOURCE,
        command=command,
        settings={
            "replications": plan.replications,
            "seeds": f"{plan.seed} to {plan.seed + plan.replications - 1}",
            "base": TRAFFIC_BASE,
            "horizon": EPISODE_SECONDS,
        },
        notes=_describe_setting(plan),
        tables=make_method_tables(runs),
        figures=collect_figures(runs),
        findings=assess_claims(runs),
        runs=_list_runs(runs),
    )


def _describe_setting(plan: TianPlan) -> list[str]:
    return [
        f"Every figure is over {plan.replications} replications (the paper has 20 and does not say how many of Monte "
        "Carlo); intervals are 95 %: of a mean by Student's distribution, of a c.o.v. by the chi-square distribution.",
        "Failure is a collision of the ego within 5 s. Systems under test: the IDM with the paper's parameters, and "
        "`noisy:idm`, an imperfect stack around it, where the paper has Apollo.",
        f"SS and ADSS have {POINTS_OF_A_LEVEL} points a level; Monte Carlo and IS stop at 20 % relative half-width; "
        f"our methods get {ADSS_SIMULATIONS:,} simulations, what the paper prints for ADSS with Apollo.",
        "Of Table III the paper's text at hand has only: Monte Carlo 2.58e-4, SS 2.49e-4 with about 5,000 simulations "
        "and IS 2.86e-4 with 237,000 (single runs, Apollo); errors of IS of 17.1 % (Apollo) and 3.8 % (IDM) and of SS "
        "of 2.6 % over 20 replications; ADSS 112 times faster than IS.",
        "The gain is the variance of plain Monte Carlo with as many simulations over the mean square error about p by "
        "Monte Carlo. Plain Monte Carlo has 1 whatever p is, so that it can be compared across papers. The error of "
        "Monte Carlo's own mean (a few percent) is left out: gains of methods that are as exact as it are understated.",
    ]


def _list_runs(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the runs of each method on each system in each scenario, a list for each of their figures."""
    groups: dict[Key, list[Run]] = {}
    for run in runs:
        groups.setdefault(row_of(run), []).append(run)
    return [
        {
            **dict(zip(ROW_COLUMNS, key, strict=True)),
            **{name: [run[name] for run in group] for name in RUN_COLUMNS},
            "warnings": [len(run["warnings"]) for run in group],
        }
        for key, group in groups.items()
    ]
