"""Leaderboard of samplers: the committed result of `rare-envs bench samplers`, and its page of the documentation.

    python -m benchmarks.estimators.sampler_leaderboard FOLDER ...

reads `benchmark.json` in the folders of benchmarks of one code, of other budgets or sets each, writes
`benchmarks/results/sampler_benchmark.json` (without the single runs) and `docs/sampler_leaderboard.md`. Without FOLDER
it writes the page alone, from the committed result.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks import RESULTS
from rare_envs.study.sampler_benchmark.leaderboard import format_leaderboard, list_plans
from rare_envs.study.sampler_benchmark.problems import ALL_PROBLEMS

LEADERBOARD_RESULT = RESULTS / "sampler_benchmark.json"
LEADERBOARD_PAGE = Path(__file__).parents[2] / "docs" / "sampler_leaderboard.md"
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
has no row at 300), `openturns-nais`, and what the commands leave out of 6,000 simulations: the sets `highdim` and
`driving`, `openturns-ce`, which goes on to 50 times its budget, `openturns-form`, whose cost is not the budget's,
and `auto`, which is `two-stage` there."""
HEAD = """\
# Leaderboard of samplers

`python -m benchmarks.estimators.sampler_leaderboard` makes this page from `benchmarks/results/sampler_benchmark.json`.
That was measured by

COMMANDS

while others computed on the machine, so that times are rough ones.

LEFT_OUT

With so few runs of each cell most faults cannot be told from chance: only gross ones are named, and the tables of whole
sets say more than single rows. Intervals of OpenTURNS' methods are p -+ 1.96 of the standard deviations that it states,
UQpy's are lognormal with the c.o.v. that it states. FORM ends where f is flat.

[A benchmark for samplers](sampler_benchmark.md) says how to add a method. A row of the committed result is a method on
a problem with a budget:

"""


def condense_results(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what is committed of benchmarks: without their runs, each cell a row, numbers to a few digits.

    Raises:
        ValueError: They are of different code, or have a cell in common.
    """
    about = {name: value for name, value in results[0]["about"].items() if name not in ("plan", "libraries")}
    for result in results:
        if any(result["about"][name] != value for name, value in about.items()):
            raise ValueError(f"Expected benchmarks of one code and machine, got {about} and {result['about']}.")
    cells = [cell for result in results for cell in result["cells"]]
    if len({(cell["method"], cell["problem"], cell["max_sim"]) for cell in cells}) < len(cells):
        raise ValueError("Expected benchmarks of other methods, problems or budgets each.")
    columns = [name for name in cells[0] if name not in ("gain_se", "reference_error")]
    warnings: dict[str, Counter[str]] = {}
    for result in results:
        for name, power in result["warnings"].items():
            warnings.setdefault(name, Counter()).update({key: power[key] for key in power if key != "texts"})
    libraries = {name: version for result in results for name, version in result["about"]["libraries"].items()}
    problems = {name: problem for result in results for name, problem in result["problems"].items()}
    plans = [result["about"]["plan"] for result in results]
    return {
        "about": {**about, "libraries": libraries, "plans": plans},
        "problems": {name: problems[name] for name in ALL_PROBLEMS if name in problems},
        "warnings": {name: dict(counts) for name, counts in warnings.items()},
        "columns": columns,
        "cells": [[_round_number(cell[name]) for name in columns] for cell in cells],
    }


def read_leaderboard() -> dict[str, Any]:
    """Return the committed result, each cell with its names."""
    result: dict[str, Any] = json.loads(LEADERBOARD_RESULT.read_text(encoding="utf-8"))
    return {**result, "cells": [dict(zip(result["columns"], row, strict=True)) for row in result["cells"]]}


def format_leaderboard_page() -> str:
    """Return the page as Markdown."""
    result = read_leaderboard()
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(READING, "reading of the page", "exec"), {})
    commands = "\n".join(f"    {_format_command(plan)}" for plan in list_plans(result))
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


def _write_result(results: Sequence[Mapping[str, Any]]) -> None:
    """Write the committed result: a line for each cell."""
    *first, (_, cells) = condense_results(results).items()
    lines = [f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in first]
    rows = ",\n".join(json.dumps(cell, allow_nan=False) for cell in cells)
    LEADERBOARD_RESULT.write_text("{" + ",\n".join([*lines, f'"cells": [\n{rows}\n]']) + "}\n", encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        files = [Path(folder) / "benchmark.json" for folder in sys.argv[1:]]
        _write_result([json.loads(file.read_text(encoding="utf-8")) for file in files])
    LEADERBOARD_PAGE.write_text(format_leaderboard_page(), encoding="utf-8")
