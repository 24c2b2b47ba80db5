"""Does a method that estimates P[f <= 0] do what it claims, and which one does it best?

    python -m benchmarks.samplers                     # our methods beside OpenTURNS', a minute or two each
    python -m benchmarks.samplers --method auto,mine:wide_draws --set fourth,mine.py --budget 300,1500 --out mine.json

runs methods many times on problems with known probabilities and counts every simulation itself. For each budget it
prints a row for each method, then a row for each problem, the worst for the first method first, with the methods' gains
side by side, coverage in brackets, and **bold** where a method's gain is more than twice that of the first. --detail
adds a table for each method.

- gain: variance of plain Monte Carlo at as many simulations, over the mean square error;
- coverage: runs whose 95 % interval holds p, with the interval that so many runs allow (Clopper and Pearson);
- low : high: runs whose interval is wholly below p, the unsafe side, and wholly above;
- far: off by more than 4 own standard errors; wrong: far, or the interval misses p; right: all others; how many warn;
- mean / p: mean of the estimates over the known probability, with its standard error;
- c.o.v.: spread of the estimates over their mean, and in brackets what the runs state;
- error / own: root mean square of a run's error over the standard error that it states;
- time: processor time of a run without f (own time: --set speed);
- faults: what the number of runs cannot explain.

With --keep each run is a line of a file; those already there are not made again, so that seeds may be added later.
"""

import argparse
import importlib.util
import json
import math
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scipy import stats

import rare_envs
from benchmarks import format_table
from benchmarks.run_lines import RunLines
from benchmarks.samplers.other_libraries import OTHER_SOLVERS
from benchmarks.samplers.problems import GROUPS, find_problem, list_problems
from benchmarks.samplers.runs import Job, MethodRun, about, find_method, map_jobs, run_once
from benchmarks.samplers.summary import Cell, Summary, cells_of, summarise
from samplers.output import to_json_value

OURS = ("auto", "two-stage", "ice", "adss", "mc")
BETTER = 2.0
"""Times the gain of the first method from which on another's is printed bold."""
HEADS = (
    *("method", "problems", "coverage", "low : high", "gain", "far: warned", "wrong: warned", "right: warned"),
    "time [ms]",
)
DETAILS = (
    *("problem", "d", "p", "mean / p", "c.o.v. (own)", "error / own", "gain", "coverage", "low : high", "U / L"),
    *("right: warned", "simulations", "calls", "time [ms]"),
)


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the arguments of the command line, methods and problems looked up."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks.samplers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    others = OTHER_SOLVERS if importlib.util.find_spec("openturns") else ()
    parser.add_argument("--method", default=",".join([*OURS, *others]), help="names, or module:attribute")
    parser.add_argument("--set", default="visible,fourth", help=f"{', '.join(GROUPS)}, or files")
    parser.add_argument("--problems", default="", help="by name instead of sets")
    parser.add_argument("--budget", default="6000", help="simulations of a run")
    parser.add_argument("--runs", type=int, default=10, help="of each method on each problem")
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument("--rotation", type=int, help="seed of another rotation of the input spaces")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--keep", type=Path, help="file of all runs, one line each")
    parser.add_argument("--out", type=Path, help="JSON file of the figures")
    parser.add_argument("--detail", action="store_true", help="a table for each method as well")
    sys.path.insert(0, "")
    options = parser.parse_args(arguments)
    try:
        options.methods = _split(options.method)
        options.problems = _split(options.problems) or [n for each in _split(options.set) for n in list_problems(each)]
        options.budgets = [int(float(each)) for each in _split(options.budget)]
        for known, names in ((find_method, options.methods), (find_problem, options.problems)):
            for name in names:
                known(name)
    except ValueError as error:
        parser.error(str(error))
    if options.runs < 2 or min(options.budgets, default=0) < 1 or options.workers < 1:
        parser.error("expected 2 runs, budgets of 1 simulation and 1 worker at least")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the methods, print the tables and write the figures."""
    options = parse_arguments(arguments)
    jobs = [
        Job(method, problem, options.seed + run, budget, rotation=options.rotation)
        for method in options.methods
        for budget in options.budgets
        for problem in options.problems
        for run in range(options.runs)
    ]
    with TemporaryDirectory() as folder:
        runs = lines_of(options.keep or Path(folder) / "runs.jsonl", options.rotation).complete(
            jobs, partial(map_jobs, run_once, workers=options.workers), progress=True
        )
    cells = cells_of(runs)
    tables = []
    for budget in options.budgets:
        groups = [[c for c in cells if (c.method, c.max_sim) == (method, budget)] for method in options.methods]
        tables.append(compare(groups))
        print("\n".join(describe(groups, tables[-1], options.detail)) + "\n")
    if options.out:
        words = " ".join(["python -m benchmarks.samplers", *(sys.argv[1:] if arguments is None else arguments)])
        content = {
            "about": about(command=re.sub(r" --(keep|out) \S+", "", words)),
            "tables": tables,
            "summaries": summaries_of(cells),
            "cells": [{**asdict(cell), "set": find_problem(cell.problem).group} for cell in cells],
        }
        options.out.write_text(json.dumps(to_json_value(content), allow_nan=False) + "\n", encoding="utf-8")


def lines_of(file: Path, rotation: int | None) -> RunLines[Job, MethodRun]:
    """Return the file of the runs, by method, problem, seed and budget."""
    return RunLines(
        file,
        {"rare_envs": rare_envs.__version__, "rotation": rotation},
        parse=lambda line: MethodRun(**{**line, "warnings": tuple(line["warnings"])}),
        encode=asdict,
        key_of_job=_key_of,
        key_of_run=_key_of,
    )


def _key_of(run: Job | MethodRun) -> tuple[str, str, int, int | None]:
    return run.method, run.problem, run.seed, run.max_sim


def compare(groups: Sequence[Sequence[Cell]]) -> dict[str, Any]:
    """Return heads and rows of the table of the methods, and of that of their gains, the worst problem first.

    Args:
        groups: The cells of each method at one budget, on the same problems in the same order.
    """
    ordered = sorted(zip(*groups, strict=True), key=lambda cells: _worst_first(cells[0]))
    rows = [(cells[0].problem, f"{cells[0].dim}", f"{cells[0].p:.2g}", *_gains_of(cells)) for cells in ordered]
    return {
        "budget": groups[0][0].max_sim,
        "methods": (HEADS, [_summary_row(summarise(group)) for group in groups]),
        "problems": (("problem", "d", "p", *(group[0].method for group in groups)), rows),
    }


def describe(groups: Sequence[Sequence[Cell]], tables: dict[str, Any], detail: bool) -> Iterator[str]:
    """Yield what is printed of a budget: the tables, the faults and, in `detail`, a table for each method."""
    first, runs = groups[0][0].method, groups[0][0].runs
    chance = stats.f.sf(BETTER, runs, runs)  # that one of two equal methods looks so much better, with Gaussian errors
    yield f"## {tables['budget']:,} simulations, {runs} runs\n"
    yield format_table(*tables["methods"])
    yield f"\nGain (coverage in %), **bold** beyond {BETTER:g} times {first}'s, {chance:.0%} by chance.\n"
    yield format_table(*tables["problems"])
    yield ""
    yield from (f"- {c.method}, {c.problem}: {'; '.join(c.faults)}" for group in groups for c in group if c.faults)
    for group in groups if detail else ():
        rows = (_detail_row(cell) for cell in sorted(group, key=_worst_first))
        yield f"\n### {group[0].method}\n\n{format_table(DETAILS, rows)}"


def summaries_of(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return the summaries by budget, method and set, and those of all sets together."""
    groups: dict[tuple[int | None, str, str], list[Cell]] = defaultdict(list)
    for cell in cells:
        for name in (find_problem(cell.problem).group, "all"):
            groups[cell.max_sim, cell.method, name].append(cell)
    return [{"set": key[2], **asdict(summarise(group))} for key, group in groups.items()]


def _worst_first(cell: Cell) -> tuple[float, ...]:
    return cell.covered.count / cell.covered.of, cell.gain if math.isfinite(cell.gain) else math.inf


def _summary_row(row: Summary) -> Sequence[str]:
    gain = f"{row.gain:,.3g}" + (f" on {row.gains}" if row.gains < row.problems else "")
    return (
        *(row.method, f"{row.problems}", f"{row.covered}", f"{row.low} : {row.high}", gain),
        *(f"{row.far_warned}", f"{row.wrong_warned}", f"{row.right_warned}", f"{1e3 * row.seconds:,.0f}"),
    )


def _gains_of(cells: Sequence[Cell]) -> Iterator[str]:
    """Yield the gain of each method on a problem, bold where it is far better than the first."""
    for cell in cells:
        mark = "**" if cell.gain > BETTER * cells[0].gain else ""
        gain = f"{cell.gain:,.3g}" if math.isfinite(cell.gain) else "-"
        yield f"{mark}{gain}{mark} ({100 * cell.covered.count / cell.covered.of:.0f})"


def _detail_row(cell: Cell) -> Sequence[str]:
    values = (
        *(cell.problem, f"{cell.dim}", f"{cell.p:.3g}", f"{cell.mean:.3f} ± {cell.mean_se:.3f}"),
        *(f"{cell.cov:.3f} ({cell.own_cov:.3f})", f"{cell.error_over_own:.2f}", f"{cell.gain:,.3g}"),
        *(f"{cell.covered}", f"{cell.low} : {cell.high}", f"{cell.upper_over_lower:.2f}"),
        *(f"{cell.right_warned}", f"{cell.n_sim:,.0f}", f"{cell.calls:.0f}", f"{1e3 * cell.seconds:,.0f}"),
    )
    return [value.replace("nan", "-") for value in values]


def _split(names: str) -> list[str]:
    return list(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))


if __name__ == "__main__":
    main()
