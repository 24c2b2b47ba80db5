"""Summary: what matters of an answer, in a line each; `printing` has the details."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

import samplers
from rare_envs.exposure import CollisionRate, summarise_human_contacts
from rare_envs.study.columns import MAX_SHOWN, draw_ordinary, find_ordinary_range, format_value, list_columns
from rare_envs.study.crash_kinds import KIND_DESCRIPTIONS
from rare_envs.study.html_report.wording import explain_no_gain
from rare_envs.study.rates.text import format_with_interval
from rare_envs.study.report import Report
from samplers.trace import describe_outcome

N_UNUSUAL = 3
"""Parameters of the most likely failure that are named at most."""
NAMED_SHARE = 1e-4
"""Share of p from which on a kind of crash is named."""


class Row(NamedTuple):
    """A line of the answer."""

    name: str
    text: str


def list_rows(report: Report) -> list[Row]:
    """Return the lines between the intervals and the most likely failure."""
    estimate = report.estimate
    return [
        *_describe_rate(report),
        Row("c.o.v.", f"{format_cov(estimate)}; gain {format_gain(estimate)}"),
        Row("method", f"{describe_run(report)}; {estimate.n_sim:,} simulations in {describe_time(report)}"),
        *([Row("chosen", estimate.choice)] if estimate.chose_another else []),
        Row("valid", estimate.proviso),
        *_describe_kinds(report),
        *_describe_severity(report),
    ]


def format_cov(estimate: samplers.Estimate) -> str:
    """Return the coefficient of variation."""
    return "not known" if math.isinf(estimate.cov) else f"{estimate.cov:.3f}"


def format_gain(estimate: samplers.Estimate) -> str:
    """Return the gain over plain Monte Carlo, and the simulations that it stands for."""
    if math.isnan(estimate.gain):
        return explain_no_gain(estimate.p)
    needed = estimate.gain * estimate.n_sim
    gain = f"{estimate.gain:,.0f}" if estimate.gain >= 100 else f"{estimate.gain:.3g}"
    return f"{gain} (plain Monte Carlo: about {needed:,.0f} simulations for the same c.o.v.)"


def describe_run(report: Report) -> str:
    """Return the method, its seed and how it ended."""
    estimate = report.estimate
    return f"{estimate.method.name}, seed {estimate.seed}, {describe_outcome(estimate.status, report.warnings)}"


def describe_time(report: Report) -> str:
    """Return the wall time, how much of it was before an interruption, and what made the rollouts."""
    text = f"{report.seconds:.1f} s"
    earlier = f" ({report.earlier_seconds:.0f} s before it was resumed)" if report.earlier_seconds else ""
    question = report.study.question
    return f"{text}{earlier} by {question.core}{'' if question.device == 'cpu' else f' on {question.device}'}"


def summarise_crash(crash: dict[str, Any], labels: tuple[str, ...]) -> str:
    """Return who ran into whom, how fast, and the risk of injury, in words; `labels` are those of the vehicles."""
    who = ["the edge of the road" if one < 0 else labels[one] for one in crash["vehicles"]]
    speeds = f"{crash['impact_speed']:.1f} m/s at contact, delta-v {max(crash['delta_v']):.1f} m/s"
    return f"{who[0]} runs into {who[1]}: {speeds}, serious injury {100 * max(crash['injury_risk']):.2g} %"


def list_unusual(report: Report) -> str:
    """Return the parameters of the most likely failure that are outside the central 90 % of ordinary scenarios.

    The furthest comes first, by the width of that range. Values of large blocks (weights, noise) are not among them.
    """
    space, x = report.study.problem.space, report.estimate.failures.x[0]
    columns = list_columns(space)
    low, high = find_ordinary_range(draw_ordinary(space))
    beyond = np.maximum(low - x, x - high) / np.maximum(high - low, 1e-12)
    shown = [j for j in np.argsort(-beyond) if beyond[j] > 0 and columns[j].shown]

    def describe(j: int) -> str:
        ends = f"[{format_value(low[j], 1)} to {format_value(high[j], 1)}]"
        return f"{columns[j].name} {format_value(x[j])} {columns[j].unit} {ends}"

    named = [describe(j) for j in shown[:N_UNUSUAL]]
    more = [f"{len(shown) - N_UNUSUAL} more"] if len(shown) > N_UNUSUAL else []
    return ", ".join([*named, *more])


def describe_failure(report: Report) -> list[str]:
    """Return the most likely failure: how it ends, and what is unusual about it."""
    failures = report.estimate.failures
    if not len(failures):
        return ["no failure found"]
    crash, labels = report.crashes[0], report.study.problem.world.scenario.labels
    what = f"f = {failures.f[0]:.3g}" if crash is None else summarise_crash(crash, labels)
    unusual = list_unusual(report)
    large = any(size > MAX_SHOWN for size in report.study.problem.space.sizes)
    none = "nothing beyond the central 90 % of ordinary scenarios" + (" but drivers' weights or noise" if large else "")
    return [
        f"most likely of {failures.total:,} failures found: {what}",
        f"  unusual in it: {f'{unusual} (in brackets the central 90 % of ordinary scenarios)' if unusual else none}",
    ]


def _describe_rate(report: Report) -> list[Row]:
    """Return collisions and injuries per million km, or why they are not known."""
    rate, injuries = report.rate, report.injury_rate
    if rate is None:
        return [Row("collisions", report.no_rate)]
    rows = [Row("collisions", f"{_describe_per_km(rate)}; {summarise_human_contacts()}")]
    if injuries is not None:
        rows.append(Row("injuries", f"{_describe_per_km(injuries)}, serious ones (MAIS 3+)"))
    return rows


def _describe_per_km(rate: CollisionRate) -> str:
    return format_with_interval(rate.per_million_km, rate.interval_per_million_km, " per million km")


def _describe_kinds(report: Report) -> list[Row]:
    """Return the shares of p by kind of crash."""
    shares = report.kinds.shares
    named = {kind: each.of_failures for kind, each in shares.items() if each.of_failures >= NAMED_SHARE}
    parts = [f"{100 * share:.3g} % {KIND_DESCRIPTIONS.get(kind, kind)}" for kind, share in named.items()]
    rare = len(shares) - len(named)
    parts += [f"{rare} rarer than {100 * NAMED_SHARE:g} %"] if rare else []
    return [Row("of which", "; ".join(parts))] if parts else []


def _describe_severity(report: Report) -> list[Row]:
    """Return the most severe collisions whose probability is known."""
    severity = report.kinds.severity
    if severity is None:
        return []
    return [Row("severity", severity.summarise())]
