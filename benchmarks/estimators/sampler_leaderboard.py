"""Leaderboard of samplers: the committed result of `rare-envs bench samplers`, and its page of the documentation.

    python -m benchmarks.estimators.sampler_leaderboard
    python -m benchmarks.estimators.sampler_leaderboard --renew FOLDER --method two-stage,auto --budget 1500

The first writes `docs/sampler_leaderboard.md` from the committed result. The second makes the rows of some methods with
some budgets anew (without `--method` or `--budget` those of all), by the commands that the page shows; it writes their
runs to FOLDER, goes on with those that are there, puts the rows in the place of the committed ones and writes the page.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import RESULTS
from rare_envs.study.sampler_benchmark.leaderboard import format_leaderboard, list_parts
from rare_envs.study.sampler_benchmark.problems import ALL_PROBLEMS
from rare_envs.study.sampler_benchmark.study import BenchmarkPlan, choose_problems, run_study
from rare_envs.threads import use_one_thread

LEADERBOARD_RESULT = RESULTS / "sampler_benchmark.json"
LEADERBOARD_PAGE = Path(__file__).parents[2] / "docs" / "sampler_leaderboard.md"
OWN = ("two-stage", "mc", "is", "ce", "ice", "ss", "adss")
OTHERS = ("openturns-ss", "uqpy-ss", "openturns-ce", "openturns-form")
ALL_SETS, LOW_SETS = ("analytic", "highdim", "driving", "public"), ("analytic", "public")


class PlannedRuns(NamedTuple):
    """Methods that run on all sets with one budget."""

    budget: int
    methods: tuple[str, ...]
    runs: int = 6
    """Of a method on a problem."""
    groups: tuple[str, ...] = ALL_SETS

    @property
    def folder(self) -> str:
        """Name of the folder of its runs."""
        return f"{self.budget}_{self.methods[0]}"


PLANNED = (
    PlannedRuns(300, (*OWN, *OTHERS, "openturns-nais")),
    PlannedRuns(1500, ("auto", *OWN, *OTHERS)),
    PlannedRuns(6000, (*OWN, "openturns-ss", "uqpy-ss"), groups=LOW_SETS),
)
WORST = 4
"""Problems in a table of the page; the committed result has all."""
DIGITS = 5
READING = """\
import json
from pathlib import Path

import rare_envs

results = Path(rare_envs.__file__).parents[1] / "benchmarks" / "results"  # of a clone of the repository
result = json.loads((results / "sampler_benchmark.json").read_text())
cells = [dict(zip(result["columns"], row)) for row in result["cells"]]
for cell in cells:
    if cell["problem"] == "cut_in_us101_d6" and cell["max_sim"] == 1500:
        print(cell["method"], f"holds p in {cell['coverage']:.0%} of {cell['runs']} runs;", *cell["faults"])
"""
LEFT_OUT = """\
Not run, for want of time: `surrogate`, which takes seconds a run (`auto` chooses it up to 500 simulations, so that it
has no row at 300), `openturns-nais` with 1,500 simulations, and what the commands leave out of 6,000: the sets
`highdim` and `driving`, `openturns-ce` and `openturns-nais`, which go on to 50 times their budget, `openturns-form`,
whose cost is not the budget's, and `auto`, which is `two-stage` there. The lines below name the code of
each row."""
HEAD = """\
# Leaderboard of samplers

`python -m benchmarks.estimators.sampler_leaderboard` makes this page from `benchmarks/results/sampler_benchmark.json`;
`--renew FOLDER --method two-stage,auto --budget 1500` makes these rows anew first, and goes on where it was stopped.
The result was measured by

COMMANDS

while others computed on the machine, so that times are rough ones. Every problem is given as f alone: a method that
uses terms or gradients of f does without them here.

LEFT_OUT

With so few runs of each cell most faults cannot be told from chance: only gross ones are named, and the tables of whole
sets say more than single rows. Intervals of OpenTURNS' methods are p -+ 1.96 of the standard deviations that it states,
UQpy's are lognormal with the c.o.v. that it states; equal seeds gave other rows on another machine for 14 of its 185
cells, and the same rows for every other method but `two-stage` (curved_d20, noisy_d6, rp54_d20; its code had changed).
FORM ends where f is flat.

[A benchmark for samplers](sampler_benchmark.md) says how to add a method. A row of the committed result is a method on
a problem with a budget:

"""


def condense_results(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what is committed of benchmarks: without their runs, each cell a row, numbers to a few digits.

    Returns:
        parts: What made each benchmark: machine, versions, digest of the code and plan.
        problems: How each probability is known.
        warnings: Runs with and without, by method and budget.
        columns, cells: A row for each method, problem and budget.

    Raises:
        ValueError: They have a cell in common.
    """
    cells = [cell for result in results for cell in result["cells"]]
    if len({(cell["method"], cell["problem"], cell["max_sim"]) for cell in cells}) < len(cells):
        raise ValueError("Expected benchmarks of other methods, problems or budgets each.")
    columns = [name for name in cells[0] if name not in ("gain_se", "reference_error", "example")]
    warnings: dict[str, dict[str, Counter[str]]] = {}
    for result in results:
        for name, budgets in result["warnings"].items():
            for budget, power in budgets.items():
                counts = warnings.setdefault(name, {}).setdefault(budget, Counter())
                counts.update({key: power[key] for key in power if key != "texts"})
    problems = {name: problem for result in results for name, problem in result["problems"].items()}
    return {
        "parts": [part for result in results for part in list_parts(result)],
        "problems": {name: problems[name] for name in ALL_PROBLEMS if name in problems},
        "warnings": {name: {key: dict(counts) for key, counts in each.items()} for name, each in warnings.items()},
        "columns": columns,
        "cells": [[_round_number(cell[name]) for name in columns] for cell in cells],
    }


def leave_out(result: Mapping[str, Any], methods: Sequence[str] = (), budgets: Sequence[int] = ()) -> dict[str, Any]:
    """Return a result, its cells with their names, without the rows of some methods with some budgets; none means all.

    Parts have one budget each.
    """

    def is_out(method: str, budget: int) -> bool:
        return (not methods or method in methods) and (not budgets or budget in budgets)

    parts = []
    for part in list_parts(result):
        kept = [name for name in part["plan"]["methods"] if not is_out(name, part["plan"]["budgets"][0])]
        if kept:
            libraries = {name: version for name, version in part["libraries"].items() if _uses(kept, name)}
            parts.append({**part, "libraries": libraries, "plan": {**part["plan"], "methods": kept}})
    warnings = {
        name: {budget: counts for budget, counts in power.items() if not is_out(name, int(budget))}
        for name, power in result["warnings"].items()
    }
    return {
        **result,
        "parts": parts,
        "warnings": {name: power for name, power in warnings.items() if power},
        "cells": [cell for cell in result["cells"] if not is_out(cell["method"], cell["max_sim"])],
    }


def _uses(methods: Sequence[str], library: str) -> bool:
    return any(name.startswith(f"{library}-") for name in methods)


def list_plans_of(methods: Sequence[str] = (), budgets: Sequence[int] = ()) -> dict[str, BenchmarkPlan]:
    """Return the benchmarks behind the rows of some methods with some budgets, by folder; none means all.

    Raises:
        ValueError: The leaderboard has no such method, or not with such a budget.
    """
    known = {name for planned in PLANNED for name in planned.methods}
    unknown = [name for name in methods if name not in known]
    if unknown:
        raise ValueError(f"Unknown method {unknown[0]!r} of the leaderboard; known: {', '.join(sorted(known))}.")
    plans = {}
    for planned in PLANNED:
        chosen = tuple(name for name in planned.methods if name in methods or not methods)
        if chosen and (planned.budget in budgets or not budgets):
            problems = choose_problems(planned.groups)
            plans[planned.folder] = BenchmarkPlan(chosen, problems, (planned.budget,), planned.runs)
    if not plans:
        raise ValueError(f"Expected budgets of {', '.join(str(each.budget) for each in PLANNED)}, got {budgets}.")
    return plans


def renew_rows(folder: Path, methods: Sequence[str] = (), budgets: Sequence[int] = ()) -> None:
    """Make rows anew, or those of all methods, and write the committed result and the page.

    Args:
        folder: Of the runs; those that are there already are not made again.
        methods: Whose rows; all if none is named.
        budgets: With these; all if none is named.
    """
    plans = list_plans_of(methods, budgets)
    with use_one_thread():
        made = [run_study(plan, folder / name, progress=True) for name, plan in plans.items()]
    old = leave_out(read_leaderboard(), methods, budgets) if methods or budgets else None
    write_leaderboard([old, *made] if old and old["cells"] else made)


def read_leaderboard() -> dict[str, Any]:
    """Return the committed result, each cell with its names."""
    result: dict[str, Any] = json.loads(LEADERBOARD_RESULT.read_text(encoding="utf-8"))
    return {**result, "cells": [dict(zip(result["columns"], row, strict=True)) for row in result["cells"]]}


def format_leaderboard_page() -> str:
    """Return the page as Markdown."""
    result = read_leaderboard()
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(READING, "reading of the page", "exec"), {})
    commands = "\n".join(f"    {_format_command(part['plan'])}" for part in list_parts(result))
    head = HEAD.replace("COMMANDS", commands).replace("LEFT_OUT", LEFT_OUT)
    example = f"```python\n{READING}```\n\n```text\n{printed.getvalue()}```\n"
    _, _, page = format_leaderboard(result, WORST).partition("\n")  # the title
    return f"{head}{example}{page}"


def _format_command(plan: Mapping[str, Any]) -> str:
    """Return the command that a plan was typed as."""
    groups = ",".join(dict.fromkeys(ALL_PROBLEMS[name].group for name in plan["problems"]))
    methods, budgets = ",".join(plan["methods"]), ",".join(map(str, plan["budgets"]))
    return (
        f"rare-envs bench samplers --method {methods} --set {groups} --budget {budgets} "
        f"--runs {plan['runs']} --seed {plan['seed']}"
    )


def _round_number(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_round_number(each) for each in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def write_leaderboard(results: Sequence[Mapping[str, Any]]) -> None:
    """Write the committed result, a line for each cell, and the page."""
    *first, (_, cells) = condense_results(results).items()
    lines = [f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in first]
    rows = ",\n".join(json.dumps(cell, allow_nan=False) for cell in cells)
    LEADERBOARD_RESULT.write_text("{" + ",\n".join([*lines, f'"cells": [\n{rows}\n]']) + "}\n", encoding="utf-8")
    LEADERBOARD_PAGE.write_text(format_leaderboard_page(), encoding="utf-8")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--renew", type=Path, metavar="FOLDER", help="make rows anew; folder of their runs")
    parser.add_argument("--method", default="", help="methods with commas whose rows are made anew")
    parser.add_argument("--budget", default="", help="budgets with commas, likewise")
    arguments = parser.parse_args()
    if arguments.renew is None:
        LEADERBOARD_PAGE.write_text(format_leaderboard_page(), encoding="utf-8")
    else:
        budgets = [int(each) for each in arguments.budget.split(",") if each]
        renew_rows(arguments.renew, [name for name in arguments.method.split(",") if name], budgets)


if __name__ == "__main__":
    main()
