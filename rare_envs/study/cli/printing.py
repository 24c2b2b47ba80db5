"""Tables and results on standard output, for a person."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console

import samplers
from rare_envs.exposure import describe_human_contacts
from rare_envs.study.cli.summary import (
    Row,
    describe_failure,
    describe_run,
    describe_time,
    format_cov,
    format_gain,
    list_rows,
    summarise_crash,
)
from rare_envs.study.columns import MAX_SHOWN, draw_ordinary, find_ordinary_range, format_value
from rare_envs.study.crash_kinds import KIND_DESCRIPTIONS
from rare_envs.study.rates.text import describe_injuries, describe_parts, format_rate, format_with_interval, name_events
from rare_envs.study.report import Report
from samplers.presentation.estimate_display import indent_lines
from samplers.problem import FloatArray

ENOUGH, MANY = 3.0, 300_000
"""Simulations over p that show with 95 % a region of failure as probable as all that was found; what they may cost."""


def print_report(report: Report, out: Path | None = None, details: bool = False) -> None:
    """Print the number, what it rests on, the most likely failure, and where the files are.

    Args:
        report: What to print.
        out: Folder of the run.
        details: Print everything: rates, kinds and severity with intervals, all parameters of the most likely failure.

    Example:
        >>> from rare_envs.study import Question, prepare, run
        >>> report = run(prepare(Question(env_id="rare_envs/CarFollowing-v0", method="mc", max_sim=100, horizon=1.0)))
        >>> print_report(report)  # doctest: +ELLIPSIS
        P[f <= 0] = 0.000e+00   rare_envs/CarFollowing-v0, ego idm
          95 % interval   0.000e+00 to ...
    """
    # markup off: P[f <= 0] and what warnings quote would be read as tags
    console = Console(highlight=False, soft_wrap=True, markup=False)
    estimate, question = report.estimate, report.study.question
    low, high = estimate.interval
    console.print(
        f"P[f <= {estimate.gamma:g}] = {estimate.p:.3e}{_format_odds(estimate.p)}   "
        f"{question.env_id}, ego {question.ego}{report.average and f', {report.average}'}",
        style="bold",
    )
    limited = report.verdict is not None
    ends = f" (each end is one-sided at {50 + 50 * estimate.confidence:g} %, for --max-p)" if limited else ""
    console.print(f"  {f'{100 * estimate.confidence:g} % interval':<15} {low:.3e} to {high:.3e}{ends}")
    if limited:
        console.print(f"  {'limit':<15} {report.verdict}", style="bold")
    for line in indent_lines(estimate.base_uncertainty or _describe_fixed_base(report)):
        console.print(line)
    _print_other_bases(console, report)
    if details:
        _print_details(console, report)
    else:
        _print_rows(console, list_rows(report))
    _print_rows(console, _list_faults(report))
    if details:
        _print_failure(console, report)
    else:
        for line in describe_failure(report):
            console.print(f"  {line}")
    if isinstance(report.sensitivity, samplers.Sensitivity):
        for line in indent_lines(report.sensitivity):
            console.print(line)
    for warning in (*(() if report.is_exact_bound else estimate.warnings), *report.doubts_of_f):
        console.print(f"warning: {warning}", style="yellow")
    for remark in report.remarks:
        console.print(f"remark: {remark}")
    for note in report.notes:
        console.print(f"note: {note}")
    if question.method != "mc" and estimate.p < estimate.unseen:
        n = float(f"{ENOUGH / estimate.p:.1g}") if estimate.p > ENOUGH / MANY else MANY
        console.print(f"check: --method mc --max-sim {n:.0f} does not rely on a search")
    if out is not None:
        names = ", ".join(path.name for path in sorted(out.iterdir()) if path.is_file())
        console.print(f"written to {out}: {names}")


def _print_rows(console: Console, rows: list[Row]) -> None:
    for name, text in rows:
        console.print(f"  {name:<15} {text}")


def _print_details(console: Console, report: Report) -> None:
    """Print rates, effort and kinds of crash with their intervals."""
    estimate = report.estimate
    _print_rate(console, report)
    _print_rows(
        console,
        [
            Row("c.o.v.", format_cov(estimate)),
            Row("simulations", f"{estimate.n_sim:,} in {describe_time(report)}"),
            Row("valid", estimate.proviso),
            Row("gain", format_gain(estimate)),
            Row("method", describe_run(report)),
            *([Row("chosen", estimate.choice)] if estimate.chose_another else []),
        ],
    )
    _print_kinds(console, report)


def _list_faults(report: Report) -> list[Row]:
    """Return the statistics that normalise observations, and the scenarios on which the ego failed."""
    rows = []
    if report.vec_normalize is not None:
        rows.append(Row("observations", f"normalised by {report.vec_normalize}"))
    if report.faults:
        first = report.faults[0].reason
        rows.append(Row("faults", f"the ego failed twice on {len(report.faults)} scenarios; the first: {first}"))
        rows.append(Row("", f"{report.n_retried:,} more simulations were made to find them"))
    return rows


def _describe_fixed_base(report: Report) -> str:
    """Return that nothing is known of the error of the base distribution."""
    name = report.study.base_name
    return f"base distribution  no interval: {name!r} has no refits to events, so p takes it as the truth"


def _print_other_bases(console: Console, report: Report) -> None:
    """Print p under the other bases that the question names, or why the simulations do not give it."""
    for each in report.other_bases:
        if each.found is None:
            console.print(f"  {f'under {each.base}':<15} not known: {each.refused}")
            console.print(
                f"  {'':<15} --base {each.base} simulates there; a larger --max-sim gives more failing points"
            )
        else:
            low, high = each.found.interval
            console.print(
                f"  {f'under {each.base}':<15} {each.found.p:.3e} ({low:.1e} to {high:.1e}), "
                f"{each.found.ess:.0f} effective failing points"
            )


def _print_rate(console: Console, report: Report) -> None:
    """Print collisions per million km and per hour beside those of people, or why they are not known."""
    rate = report.rate
    if rate is None:
        console.print(f"  {'collisions':<15} {report.no_rate}")
        return
    console.print(
        f"  {'collisions':<15} "
        f"{format_with_interval(rate.per_million_km, rate.interval_per_million_km, ' per million km')}, "
        f"{format_with_interval(rate.per_hour, rate.interval_per_hour, ' per hour')}; {describe_human_contacts()}"
    )
    events = f"{format_rate(rate.frequency.per_km)} {name_events(rate.scenario)} per km"
    parts = describe_parts(rate)
    console.print(f"  {'':<15} from {events}{f'; the uncertainty is {parts}' if parts else ''}")
    if report.injury_rate is not None:
        console.print(f"  {'':<15} {describe_injuries(report.injury_rate)}")


def _print_kinds(console: Console, report: Report) -> None:
    """Print p by kind of crash, and how severe the collisions are."""
    for number, (kind, share) in enumerate(report.kinds.shares.items()):
        low, high = share.interval
        share_of_p = f"{share.p:.1e} [{low:.1e}, {high:.1e}], {100 * share.of_failures:.3g} %"
        text = f"{share_of_p}: {KIND_DESCRIPTIONS.get(kind, kind)}"
        console.print(f"  {'of which' if number == 0 else '':<15} {text}")
    for number, line in enumerate(str(report.kinds.severity or "").splitlines()):
        console.print(f"  {'severity' if number == 0 else '':<15} {line}")


def _format_odds(p: float) -> str:
    """Return a small probability in words."""
    return f" (1 in {1 / p:,.0f} scenarios)" if 0 < p < 0.1 else ""


def _print_failure(console: Console, report: Report) -> None:
    """Print the most likely failure beside the range that is ordinary for each parameter."""
    failures, space = report.estimate.failures, report.study.problem.space
    if not len(failures):
        console.print("  no failure found")
        return
    ordinary = draw_ordinary(space)
    console.print(
        f"  most likely of {failures.total:,} failures found (f = {failures.f[0]:.3g}; "
        "in brackets the central 90 % of ordinary scenarios):"
    )
    if report.crashes[0] is not None:
        console.print(f"    {summarise_crash(report.crashes[0], report.study.problem.world.scenario.labels)}")
    normal = space.columns(space.to_standard_normal(np.vstack((failures.x[:1], ordinary))))
    likeliest, usual = space.columns(failures.x[:1]), space.columns(ordinary)
    for j, name in enumerate(space.names):
        if space.sizes[j] <= MAX_SHOWN:
            (low,), (high,) = find_ordinary_range(usual[name].reshape(-1, 1))  # of all values of a block
            values = " ".join(f"{format_value(value):>8}" for value in likeliest[name].flat)
            console.print(
                f"    {name:<15} {values} {space.units[j]:<4} [{format_value(low, 1)} to {format_value(high, 1)}]"
            )
        else:
            console.print(f"    {name:<15} {_summarise_block(name, likeliest[name][0], usual[name], normal[name])}")


def _summarise_block(name: str, values: FloatArray, ordinary: FloatArray, normal: FloatArray) -> str:
    """Return a summary of a block of many values."""
    distance = np.linalg.norm(normal, axis=1)
    low, high = np.quantile(distance[1:], (0.05, 0.95))
    spread = (values - ordinary.mean(axis=0)) / np.maximum(ordinary.std(axis=0), 1e-12)
    furthest = int(np.abs(spread).argmax())
    return (
        f"{len(values):,} values, {distance[0]:.2f} standard deviations from their mean [{low:.1f} to {high:.1f}], "
        f"most in {name}[{furthest}], {spread[furthest]:+.1f}"
    )
