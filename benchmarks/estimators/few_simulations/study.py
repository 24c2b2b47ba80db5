"""Gain and coverage of `Surrogate`, and of `TwoStage` beside it, with 100, 300 and 1,000 simulations.

    python -m benchmarks.estimators.few_simulations.study --set /path/of/problems.py --runs few_simulations.jsonl \
        --json benchmarks/results/few_simulations.json

The problems are those of the sets given, the driving scenarios with IDM, and the held-out states, on which nothing was
chosen; `--problems` selects among them. `--runs` keeps every run as a line of its own; those already there are not made
again, so that a study may be interrupted and seeds be added later. `--seeds` has a number for each budget.
"""

import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from benchmarks.estimators.few_simulations import driving_states, held_out_states
from benchmarks.estimators.two_stage.repeated_seeds import (
    HEADER,
    NamedState,
    Row,
    SeededRun,
    describe_row,
    load_set,
    run_seed,
    summarise_runs,
)
from benchmarks.samplers.runs import about
from samplers.output import to_json_value


class Cell(NamedTuple):
    """What is repeated with many seeds."""

    state: NamedState
    method: str
    max_sim: int


class RunFile:
    """Runs by cell and seed, kept in a file of one line each.

    Args:
        path: The file; None keeps them in memory.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._runs: dict[tuple[str, str, int, int], SeededRun] = {}
        lines = path.read_text(encoding="utf-8").splitlines() if path is not None and path.exists() else []
        for row in map(json.loads, lines):
            method, max_sim = row.pop("method"), row.pop("max_sim")
            run = SeededRun(**{**row, "warnings": tuple(row["warnings"])})
            self._runs[run.problem, method, max_sim, run.seed] = run

    def find(self, cell: Cell, seeds: int) -> list[SeededRun]:
        """Return those of the first runs that are there."""
        keys = [(cell.state.name, cell.method, cell.max_sim, seed) for seed in range(seeds)]
        return [self._runs[key] for key in keys if key in self._runs]

    def get(self, cell: Cell, seed: int) -> SeededRun:
        """Return a run, made now if it is not there."""
        key = (cell.state.name, cell.method, cell.max_sim, seed)
        if key not in self._runs:
            self._runs[key] = run = run_seed(cell.state, cell.method, seed, cell.max_sim)
            if self._path is not None:
                line = {"method": cell.method, "max_sim": cell.max_sim, **asdict(run)}
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
        return self._runs[key]


def find_states(sets: Iterable[Path], wanted: Iterable[str]) -> list[NamedState]:
    """Return the states of the sets, the driving and the held-out ones; of the names wanted, if there are any."""
    named = set(wanted) - {""}
    files = [*sets, Path(driving_states.__file__), Path(held_out_states.__file__)]
    return [state for path in files for state in load_set(path) if not named or state.name in named]


def summarise_cells(
    cells: Iterable[Cell], seeds: dict[int, int], runs: RunFile, *, made: bool
) -> Iterator[tuple[Cell, Row]]:
    """Yield each cell with its row, as soon as its runs are there; those without a run are left out.

    Args:
        cells: All of them.
        seeds: Runs of a cell by the simulations of a run.
        runs: What is there.
        made: Whether only runs count that are there.
    """
    for cell in cells:
        n = seeds[cell.max_sim]
        found = runs.find(cell, n) if made else [runs.get(cell, seed) for seed in range(n)]
        if found:
            yield cell, summarise_runs(cell.state.name, found)


def main(
    sets: Annotated[list[Path] | None, typer.Option("--set", help="Files of further limit states.")] = None,
    problems: Annotated[str, typer.Option(help="Names, with commas; none: all.")] = "",
    budgets: Annotated[str, typer.Option(help="Simulations of a run, with commas.")] = "300,100,1000",
    seeds: Annotated[str, typer.Option(help="Runs of each problem, one number for each budget.")] = "20,20,20",
    methods: Annotated[str, typer.Option(help="Names of methods, with commas.")] = "surrogate",
    runs: Annotated[Path | None, typer.Option(help="File of all runs, one line each.")] = None,
    made: Annotated[bool, typer.Option(help="Make no run; summarise those that are in the file.")] = False,
    json_path: Annotated[Path | None, typer.Option("--json", help="File of the table.")] = None,
) -> None:
    """Run with many seeds and print gain, coverage and warnings."""
    sizes = [int(word) for word in budgets.split(",")]
    repeats = dict(zip(sizes, map(int, seeds.split(",")), strict=True))
    states, kept, rows = find_states(sets or [], problems.split(",")), RunFile(runs), []
    cells = [Cell(state, method, size) for size in sizes for method in methods.split(",") for state in states]
    print(HEADER)
    for cell, row in summarise_cells(cells, repeats, kept, made=made):
        print(describe_row(row), cell.method, flush=True)
        rows.append({"method": cell.method, "max_sim": cell.max_sim, **asdict(row)})
        if json_path is not None:
            write_table(json_path, rows)


def write_table(path: Path, rows: list[dict[str, object]]) -> None:
    """Write the rows made so far."""
    names = [Path(word).name if word.endswith((".py", ".jsonl")) else word for word in sys.argv[1:]]
    command = " ".join(["python -m benchmarks.estimators.few_simulations.study", *names])
    content = {"about": about(command=command), "rows": rows}
    path.write_text(json.dumps(to_json_value(content), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
