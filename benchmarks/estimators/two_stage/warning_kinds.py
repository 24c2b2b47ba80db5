"""Which warnings tell wrong runs from right ones: how often each kind comes in runs that `repeated_seeds` has kept.

    python -m benchmarks.estimators.two_stage.warning_kinds third.jsonl hard.jsonl --json benchmarks/results/KINDS.json

Far off are runs that err by more than four of their own standard errors. A kind is the first words of a warning without
their numbers.
"""

import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.estimators.two_stage.repeated_seeds import SeededRun, read_runs
from benchmarks.samplers.runs import about

WORDS = 6
"""First words of a text that name its kind."""
HEADER = """| warning | far off, of {far_off} | others, of {others} |
|---|---|---|"""


@dataclass(frozen=True)
class WarningKind:
    """How often a kind of warning came."""

    kind: str
    far_off: int
    """Runs with it that were far off."""
    others: int
    """Other runs with it."""


def name_kind(text: str) -> str:
    """Return the first words of a warning, numbers replaced by n.

    Example:
        >>> name_kind("Effective sample size of 2,197 draws: 31 failures; larger weights may be missing.")
        'Effective sample size of n draws'
    """
    return " ".join(re.sub(r"[\d,.e-]*\d[\d,.e+-]*", "n", text).split()[:WORDS]).rstrip(":")


def count_kinds(runs: Sequence[SeededRun]) -> list[WarningKind]:
    """Return the kinds of warnings of some runs and, last, that of having any; each counts once a run."""
    counts = {True: Counter[str](), False: Counter[str]()}
    for run in runs:
        kinds = {name_kind(text) for text in run.warnings}
        counts[run.far_off].update(kinds | ({"any"} if kinds else set()))
    names = sorted(set(counts[True]) | set(counts[False]) - {"any"}, key=lambda kind: -counts[False][kind])
    order = [*(name for name in names if name != "any"), "any"]
    return [WarningKind(kind, counts[True][kind], counts[False][kind]) for kind in order]


def main(
    paths: Annotated[list[Path], typer.Argument(help="Files of runs.")],
    json_path: Annotated[Path | None, typer.Option("--json", help="File of the table.")] = None,
) -> None:
    """Print how often each kind of warning came in far-off runs and in others."""
    runs = [run for path in paths for run in read_runs(path)]
    far_off = sum(run.far_off for run in runs)
    rows = count_kinds(runs)
    print(HEADER.format(far_off=far_off, others=len(runs) - far_off))
    for row in rows:
        print(f"| {row.kind} | {row.far_off} | {row.others} |")
    if json_path is not None:
        command = " ".join(["python -m benchmarks.estimators.two_stage.warning_kinds", *(path.name for path in paths)])
        content = {
            "about": about(command=command, runs=len(runs), far_off=far_off),
            "rows": [asdict(row) for row in rows],
        }
        json_path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
