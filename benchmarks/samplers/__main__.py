"""Does a method that estimates P[f <= 0] do what it claims?

    python -m benchmarks.samplers --method auto,mc,openturns-nais --set analytic,public --budget 300,1500 --runs 20
    python -m benchmarks.samplers --method mine:wide_draws --set problems_fourth.py --out mine.json

runs methods many times on problems with known probabilities, counts every simulation itself, and prints a table for
each method and budget, its worst problems first; there is no ranking by one number.

- mean / p: mean of the estimates over the known probability, with its standard error;
- c.o.v.: spread of the estimates over their mean, and in brackets what the runs state;
- error / own: root mean square of a run's error over the standard error that it states;
- gain: variance of plain Monte Carlo at as many simulations, over the mean square error;
- coverage: runs whose 95 % interval holds p, with the interval that so many runs allow (Clopper and Pearson);
- low : high: runs whose interval is wholly below p, the unsafe side, and wholly above; U / L: ratio of its ends;
- time: processor time of a run without f (own time: --set speed --budget 6000);
- faults: what the number of runs cannot explain.

With --keep each run is a line of a file; those already there are not made again, so that seeds may be added later.
"""

import argparse
import json
import math
import statistics
import sys
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import rare_envs
from benchmarks.run_lines import RunLines
from benchmarks.samplers.problems import GROUPS, find_problem, list_problems
from benchmarks.samplers.runs import Job, MethodRun, about, find_method, map_jobs, run_once
from benchmarks.samplers.summary import Cell, Power, cells_of, find_faults, power_of
from samplers.output import to_json_value
from samplers.sample import clopper_pearson

COLUMNS = (
    *("problem", "d", "p", "mean / p", "c.o.v. (own)", "error / own", "gain", "coverage %", "low : high", "U / L"),
    *("warned %", "simulations", "calls", "time [ms]", "faults"),
)


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the arguments of the command line, methods and problems looked up."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks.samplers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--method", default="auto,mc,adss", help="names, openturns-*, uqpy-ss or module:attribute")
    parser.add_argument("--set", default="analytic,public", help=f"{', '.join(GROUPS)}, or files")
    parser.add_argument("--problems", default="", help="by name instead of sets")
    parser.add_argument("--budget", default="300,1500,6000", help="simulations of a run")
    parser.add_argument("--runs", type=int, default=20, help="of each method on each problem")
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument("--rotation", type=int, help="seed of another rotation of the input spaces")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--keep", type=Path, help="file of all runs, one line each")
    parser.add_argument("--out", type=Path, help="JSON file of the figures")
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
    groups = {(cell.method, cell.max_sim): [] for cell in cells}
    for cell in cells:
        groups[cell.method, cell.max_sim].append(cell)
    for (method, budget), own in groups.items():
        power = power_of([run for run in runs if (run.method, run.max_sim) == (method, budget)])
        print("\n".join([f"## {method}, {budget:,} simulations", "", *describe_group(own, power), ""]))
    if options.out:
        names = {"methods": options.methods, "budgets": options.budgets, "runs": options.runs, "seed": options.seed}
        content = {
            "about": about(command="python -m benchmarks.samplers", **names),
            "rows": [{**asdict(cell), "faults": faults_of(cell)} for cell in cells],
        }
        options.out.write_text(json.dumps(to_json_value(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")


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


def faults_of(cell: Cell) -> tuple[str, ...]:
    """Return the faults of a cell; regions that no method can know of are none."""
    return find_faults(cell, find_problem(cell.problem).knowable)


def describe_group(cells: Sequence[Cell], power: Power) -> list[str]:
    """Return what holds of a method at a budget over all its problems, and the table of them, the worst first."""
    counted = [cell for cell in cells if cell.p > 0 and find_problem(cell.problem).knowable]
    runs = sum(cell.runs for cell in counted)
    held = sum(round(cell.coverage * cell.runs) for cell in counted)
    low, high = sum(cell.low for cell in counted), sum(cell.high for cell in counted)
    gains = [cell.gain for cell in counted if math.isfinite(cell.gain)]
    gain = statistics.geometric_mean(gains) if gains else math.nan
    return [
        f"- Intervals hold p in {_share(held, runs)}; {low} lie below it, {high} above. "
        f"Geometric mean of the gains: {gain:.3g}.",
        f"- Warned of runs off by more than 4 own standard errors: {_share(power.wrong_warned, power.wrong)}; "
        f"within 2: {_share(power.right_warned, power.right)}.",
        "",
        f"| {' | '.join(COLUMNS)} |",
        "|---" * len(COLUMNS) + "|",
        *(_describe_cell(cell) for cell in sorted(cells, key=_worst_first)),
    ]


def _worst_first(cell: Cell) -> tuple[float, ...]:
    return -len(faults_of(cell)), cell.coverage, cell.gain if math.isfinite(cell.gain) else math.inf


def _describe_cell(cell: Cell) -> str:
    low, high = cell.coverage_interval
    values = [
        *(cell.problem, f"{cell.dim}", f"{cell.p:.3g}", f"{cell.mean:.3f} ± {cell.mean_se:.3f}"),
        *(f"{cell.cov:.3f} ({cell.own_cov:.3f})", f"{cell.error_over_own:.2f}", f"{cell.gain:,.3g}"),
        *(f"{100 * cell.coverage:.0f} ({100 * low:.0f} to {100 * high:.0f})", f"{cell.low} : {cell.high}"),
        *(f"{cell.upper_over_lower:.2f}", f"{100 * cell.warned:.0f}", f"{cell.n_sim:,.0f}", f"{cell.calls:.0f}"),
        *(f"{1e3 * cell.seconds:,.0f}", "; ".join(faults_of(cell)).replace("|", "/")),
    ]
    return f"| {' | '.join(values)} |".replace("nan", "-")


def _share(number: int, of: int) -> str:
    """Return a share with its 95 % interval in words."""
    if of == 0:
        return "0 of 0"
    low, high = clopper_pearson(number, of, 0.95)
    return f"{number} of {of} ({100 * number / of:.1f} %; {100 * low:.1f} to {100 * high:.1f})"


def _split(names: str) -> list[str]:
    return list(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))


if __name__ == "__main__":
    main()
