"""Page of a benchmark: one table for each method and budget, its worst problems first.

Methods are in the order of their names and in no ranking: no single number says which is best.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from samplers.statistics import clopper_pearson

PAGE_COLUMNS = (
    "problem | p | mean / p | c.o.v. | gain | coverage % (95 %) | below p % | above p % | own / real c.o.v. | warned % "
    "| simulations | own time [ms] | faults"
)
EXPLANATION = """\
- *mean / p*: mean of the estimates over the known probability, with its standard error.
- *c.o.v.*: spread of the estimates over their mean.
- *gain*: variance of plain Monte Carlo at as many simulations, over the mean square error.
- *coverage*: runs whose 95 % interval holds p, with the interval that so many runs allow (Clopper and Pearson).
- *below p*, *above p*: runs whose interval is wholly below p, the unsafe side, and wholly above.
- *own / real c.o.v.*: what the runs state over the spread of their estimates.
- *simulations*: all that were made, counted by the benchmark, search and fit included.
- *own time*: processor time of a run without f.
- *faults*: what the number of runs cannot explain (`samplers.benchmark.find_faults`).
"""


OVERVIEW_COLUMNS = (
    "method | simulations | problems with faults | coverage % (95 %) | below p % | above p % | no answer % | warned %"
)


def format_leaderboard(result: Mapping[str, Any], most: int | None = None) -> str:
    """Return the page of a benchmark as Markdown.

    Args:
        result: What `rare_envs.study.sampler_benchmark.study.summarise_study` returns.
        most: Problems in a table, the worst; None for all.
    """
    methods = sorted({cell["method"] for cell in result["cells"]})
    lines = [
        "# Samplers on problems with known probabilities",
        "",
        *map(_describe_part, list_parts(result)),
        "",
        EXPLANATION,
        "## All problems of a set together",
        "",
        "In alphabetical order. Problems whose region no method can know of are left out.",
        "",
        *_format_overview(result),
    ]
    for method in methods:
        lines += [f"## {method}", ""]
        for budget, cells in _cells_by_budget(result, method).items():
            warned = _describe_warnings(result["warnings"][method][str(budget)])
            lines += [f"### {budget:,} simulations", "", warned, "", *_format_table(cells, most), ""]
    return "\n".join([*lines, *_format_problems(result["problems"])]) + "\n"


def list_parts(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return what made a benchmark, with its plan: of several whose cells were put together, of each."""
    parts: list[Mapping[str, Any]] = result.get("parts") or [result["about"]]
    return parts


def _describe_part(about: Mapping[str, Any]) -> str:
    """Return what was run, by what, in a line."""
    plan = about["plan"]
    libraries = "".join(f"{name} {version}, " for name, version in about["libraries"].items())
    return (
        f"- {plan['runs']} runs of each of {len(plan['methods'])} methods ({_join(plan['methods'])}) on "
        f"{len(plan['problems'])} problems, budgets of {_join(f'{each:,}' for each in plan['budgets'])} simulations, "
        f"seeds from {plan['seed']}: rare_envs {about['rare_envs']} (code {about['code']}), NumPy {about['numpy']}, "
        f"SciPy {about['scipy']}, {libraries}Python {about['python']}, {about['processor']}."
    )


def _cells_by_budget(result: Mapping[str, Any], method: str) -> dict[int, list[Mapping[str, Any]]]:
    """Return the cells of a method, the least budget first."""
    own = [cell for cell in result["cells"] if cell["method"] == method]
    budgets = sorted({cell["max_sim"] for cell in own})
    return {budget: [cell for cell in own if cell["max_sim"] == budget] for budget in budgets}


def sort_worst_first(cells: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the cells of a method: those with most faults first, then by coverage and gain, the least first."""
    return sorted(
        cells,
        key=lambda cell: (-len(cell["faults"]), cell["coverage"], math.inf if cell["gain"] is None else cell["gain"]),
    )


def _format_table(cells: Sequence[Mapping[str, Any]], most: int | None) -> list[str]:
    shown = sort_worst_first(cells)[:most]
    left = [] if len(shown) == len(cells) else ["", f"The worst {len(shown)} of {len(cells)} problems."]
    return [*_format_head(PAGE_COLUMNS), *(_format_row(cell) for cell in shown), *left]


def _format_overview(result: Mapping[str, Any]) -> list[str]:
    """Return a table for each set: the runs of each method and budget on all its problems."""
    lines = []
    for group in dict.fromkeys(problem["group"] for problem in result["problems"].values()):
        names = {name for name, problem in result["problems"].items() if problem["group"] == group}
        lines += [f"### Set {group}", "", *_format_head(OVERVIEW_COLUMNS)]
        for method in sorted({cell["method"] for cell in result["cells"]}):
            for budget, of_method in _cells_by_budget(result, method).items():
                cells = [
                    cell
                    for cell in of_method
                    if cell["problem"] in names and result["problems"][cell["problem"]]["knowable"]
                ]
                lines += [_format_pooled(method, budget, cells)] if cells else []
        lines.append("")
    return lines


def _format_pooled(method: str, budget: int, cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the row of a method's runs on several problems."""
    runs = sum(cell["runs"] for cell in cells)
    shares = {name: sum(cell[name] * cell["runs"] for cell in cells) / runs for name in ("coverage", "below")}
    raised = sum(cell["raised"] for cell in cells) / runs
    warned = (
        sum((cell["warned"] or 0.0) * (cell["runs"] - cell["raised"]) for cell in cells) / runs
    )  # of those that end
    low, high = clopper_pearson(round(shares["coverage"] * runs), runs, 0.95)
    above = max(0.0, 1.0 - shares["coverage"] - shares["below"] - raised)
    values = [
        method,
        f"{budget:,}",
        f"{sum(bool(cell['faults']) for cell in cells)} of {len(cells)}",
        f"{100 * shares['coverage']:.0f} ({100 * low:.0f} to {100 * high:.0f})",
        *(f"{100 * share:.0f}" for share in (shares["below"], above, raised, warned)),
    ]
    return f"| {' | '.join(values)} |"


def _format_problems(problems: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the table of the problems and of how their probabilities are known."""
    columns = "problem | set | dimensions | p | standard error | draws | how it is known | checked by"
    lines = ["## Problems", "", *_format_head(columns)]
    for name, problem in problems.items():
        error = f"{problem['standard_error']:.1e}" if problem["standard_error"] else "0"
        draws = f"{problem['draws']:,}" if problem["draws"] else "-"
        known = problem["reference"] + ("" if problem["knowable"] else "; no method can know of its main region")
        numbers = f"{problem['dim']} | {problem['p']:.5g} | {error} | {draws}"
        lines.append(f"| {name} | {problem['group']} | {numbers} | {known} | {problem['second']} |")
    return lines


def _format_head(columns: str) -> list[str]:
    return [f"| {columns} |", "|---" * (columns.count("|") + 1) + "|"]


def _format_row(cell: Mapping[str, Any]) -> str:
    low, high = cell["coverage_interval"]
    above = max(0.0, 1.0 - cell["coverage"] - cell["below"] - cell["raised"] / cell["runs"])
    values = [
        cell["problem"],
        f"{cell['p']:.3g}",
        f"{_number(cell['mean_over_p'], '.3f')} ± {_number(cell['mean_se'], '.3f')}",
        _number(cell["cov"], ".3f"),
        _number(cell["gain"], ",.3g"),
        f"{100 * cell['coverage']:.0f} ({100 * low:.0f} to {100 * high:.0f})",
        f"{100 * cell['below']:.0f}",
        f"{100 * above:.0f}",
        _number(cell["own_over_cov"], ".2f"),
        _number(cell["warned"], ".0%").rstrip("%"),
        f"{cell['n_sim']:,.0f}",
        f"{1e3 * cell['seconds']:,.0f}",
        "; ".join(cell["faults"]).replace("|", "/"),
    ]
    return f"| {' | '.join(values)} |"


def _describe_warnings(power: Mapping[str, Any]) -> str:
    """Return how often the warnings of a method come with the runs that are wrong, and with those that are right."""
    hit = _format_share(power["wrong_warned"], power["wrong"])
    false = _format_share(power["right_warned"], power["right"])
    return (
        f"Warnings: of runs that are off by more than 4 of their own standard errors {hit} have one; of runs within 2 "
        f"{false} have one (false alarms)."
    )


def _format_share(number: int, of: int) -> str:
    """Return a share with its 95 % interval in words."""
    if of == 0:
        return "none of 0"
    low, high = clopper_pearson(number, of, 0.95)
    return f"{number} of {of} ({100 * number / of:.0f} %; {100 * low:.0f} to {100 * high:.0f})"


def _number(value: float | None, spec: str) -> str:
    return "-" if value is None else format(value, spec)


def _join(words: Any) -> str:
    return ", ".join(words)
