"""Leaderboard of samplers: the committed result of `rare-envs bench samplers`, and its page of the documentation.

    python -m benchmarks.estimators.sampler_leaderboard FOLDER

reads `benchmark.json` in the folder of a benchmark, writes `benchmarks/results/sampler_benchmark.json` (without the
single runs) and `docs/sampler_leaderboard.md`. Without FOLDER it writes the page alone, from the committed result.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import RESULTS
from rare_envs.study.sampler_benchmark.leaderboard import format_leaderboard

LEADERBOARD_RESULT = RESULTS / "sampler_benchmark.json"
LEADERBOARD_PAGE = Path(__file__).parents[2] / "docs" / "sampler_leaderboard.md"
WORST = 6
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
HEAD = """\
# Leaderboard of samplers

`python -m benchmarks.estimators.sampler_leaderboard` makes this page from `benchmarks/results/sampler_benchmark.json`.
That was measured by

    rare-envs bench samplers --method METHODS --set analytic,highdim,driving --budget BUDGETS --runs RUNS --seed SEED

Not run, for want of time: `surrogate` by itself, which takes seconds a run (`auto` chooses it at small budgets),
`openturns-nais`, and the set `public`. With so few runs of each cell most faults cannot be told from chance: only gross
ones are named, and the tables of whole sets say more than single rows. Intervals of OpenTURNS' methods are p -+ 1.96 of
the standard deviations that it states, UQpy's are lognormal with the c.o.v. that it states. FORM ends where f is flat.

[A benchmark for samplers](sampler_benchmark.md) says how to add a method. A row of the committed result is a method on
a problem with a budget:

"""


def condense_result(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is committed of a benchmark: without its runs, each cell a row, numbers to a few digits."""
    cells = result["cells"]
    columns = [name for name in cells[0] if name not in ("gain_se", "reference_error")]
    return {
        "about": result["about"],
        "problems": result["problems"],
        "warnings": {
            name: {key: value for key, value in power.items() if key != "texts"}
            for name, power in result["warnings"].items()
        },
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
    plan = result["about"]["plan"]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(READING, "reading of the page", "exec"), {})
    head = HEAD.replace("METHODS", ",".join(plan["methods"])).replace("SEED", str(plan["seed"]))
    head = head.replace("BUDGETS", ",".join(map(str, plan["budgets"]))).replace("RUNS", str(plan["runs"]))
    example = f"```python\n{READING}```\n\n```text\n{printed.getvalue()}```\n"
    _, _, page = format_leaderboard(result, WORST).partition("\n")  # the title
    return f"{head}{example}{page}"


def _round_number(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_round_number(each) for each in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _write_result(result: Mapping[str, Any]) -> None:
    """Write the committed result: a line for each cell."""
    *first, (_, cells) = condense_result(result).items()
    lines = [f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in first]
    rows = ",\n".join(json.dumps(cell, allow_nan=False) for cell in cells)
    LEADERBOARD_RESULT.write_text("{" + ",\n".join([*lines, f'"cells": [\n{rows}\n]']) + "}\n", encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _write_result(json.loads((Path(sys.argv[1]) / "benchmark.json").read_text(encoding="utf-8")))
    LEADERBOARD_PAGE.write_text(format_leaderboard_page(), encoding="utf-8")
