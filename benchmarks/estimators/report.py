"""Figures of a benchmark as Markdown."""

from collections.abc import Sequence

from benchmarks.estimators.targets import Verdict, pooled_coverage
from samplers.benchmark.catalogue import PROBLEMS
from samplers.benchmark.summary import Cell, Power

REPORT_COLUMNS = (
    "method | problem | p | mean/p | c.o.v. | own | own / real | gain | coverage % | warned % | worst error | n_sim "
    "| calls | own time [ms]"
)


def format_cells(cells: Sequence[Cell]) -> str:
    """Return one row for each cell; a last column says how many runs raised, where some did."""
    raised = any(cell.raised for cell in cells)
    columns = REPORT_COLUMNS + (" | raised" if raised else "")
    lines = [f"| {columns} |", "|---" * (columns.count("|") + 1) + "|"]
    for c in cells:
        values = [
            *(c.method, c.problem, f"{c.p:.3g}", f"{c.mean_over_p:.3f} ± {c.mean_se:.3f}", f"{c.cov:.3f}"),
            *(f"{c.own_cov:.3f}", f"{c.own_over_cov:.2f}", f"{c.gain:,.3g} ± {c.gain_se:,.2g}"),
            *(f"{100 * c.coverage:.1f}", f"{100 * c.warned:.0f}", f"{c.worst:.2f}", f"{c.n_sim:,.0f}"),
            *(f"{c.calls:.1f}", f"{1e3 * c.seconds:.0f}"),
        ]
        lines.append(f"| {' | '.join(values + [str(c.raised)] * raised)} |")
    return "\n".join(lines)


def summary(cells: Sequence[Cell], power: Power, verdicts: Sequence[Verdict]) -> str:
    """Return what holds over all cells of one method."""
    pooled, runs = pooled_coverage(cells)
    low = [
        f"{cell.problem} {100 * cell.coverage:.0f}"
        for cell in cells
        if cell.p > 0 and cell.coverage < 0.88 and PROBLEMS[cell.problem].knowable
    ]
    left_out = [cell.problem for cell in cells if cell.p == 0 or not PROBLEMS[cell.problem].knowable]
    note = f" (without {', '.join(left_out)})" if left_out else ""
    lines = [
        f"## {cells[0].method}",
        "",
        f"- Pooled coverage {100 * pooled:.1f} % of {runs:,} runs{note}; under 88 %: {', '.join(low) or 'none'}.",
        f"- Off by more than 4 own standard errors: {power.wrong} runs, {_percent(power.wrong_warned, power.wrong)} "
        f"of them with a warning; within 2: {power.right} runs, {_percent(power.right_warned, power.right)} warned.",
        "",
    ]
    if power.texts:
        lines += ["| warning | wrong runs | right runs | others |", "|---|---|---|---|"]
        lines += [f"| {text} | {a} | {b} | {c} |" for text, (a, b, c) in power.texts.items()]
        lines.append("")
    missed = [f"{verdict.target} ({verdict.measured:.4g})" for verdict in verdicts if not verdict.met]
    lines.append(f"Targets met: {sum(verdict.met for verdict in verdicts)} of {len(verdicts)}.")
    lines += [f"- missed: {text}" for text in missed]
    return "\n".join(lines)


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %" if whole else "none"
