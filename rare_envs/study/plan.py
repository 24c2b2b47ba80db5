"""Plan: simulations and wall time for a wished coefficient of variation, from the folder of a run or from pilots."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import samplers
from rare_envs.study.arguments import Question
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.study.evaluate import run
from rare_envs.study.question import prepare


def plan_from_result(recorded: Mapping[str, Any], target_cov: float) -> tuple[samplers.PlannedRun, ...]:
    """Return what the method of a run, and plain Monte Carlo, need."""
    p, cov, n_sim, seconds = (_read_number(recorded, name) for name in ("p", "cov", "n_sim", "seconds"))
    described = recorded.get("method")
    name = described.get("name") if isinstance(described, Mapping) else None
    with as_bad_input(ValueError):
        method = samplers.get_method(name if isinstance(name, str) else reprlib.repr(name))
        final = _read_number(recorded, "final_draws") if recorded.get("final_draws") is not None else None
        if final is not None and final > n_sim:
            raise ValueError(f"The result of the run says {final:g} final draws of {n_sim:g} simulations.")
        pilot = samplers.Pilot(
            method=method.name,
            p=p,
            cov=cov,
            n_sim=int(n_sim),
            final_draws=int(final) if final is not None and method.stops_at_target else None,
            seconds=seconds,
        )
        return samplers.plan_runs(pilot, target_cov)


def plan_by_pilots(
    question: Question, methods: Sequence[str], target_cov: float, progress: bool = False
) -> tuple[samplers.PlannedRun, ...]:
    """Run a pilot by each method, and return what each needs; plain Monte Carlo last."""
    found: dict[str, samplers.PlannedRun] = {}
    with as_bad_input(ValueError):
        for name in methods:  # all of them before the first pilot, which may take hours
            samplers.get_method(name)
    study = prepare(replace(question, method=methods[0], ensemble_run=False))
    for name in methods:
        with as_bad_input(ValueError):
            method = samplers.get_method(name)
            asked = replace(study, question=replace(study.question, method=name), method=method)
            report = run(asked, progress)
            for planned in samplers.plan_runs(report.estimate.pilot(report.seconds), target_cov):
                if planned.method != "mc" or planned.method not in found:
                    found[planned.method] = planned
    last = found.pop("mc")
    return (*found.values(), last)


def format_seconds(seconds: float) -> str:
    """Return a time in a unit of its size."""
    for size, unit in ((120.0, "s"), (7200.0, "min")):
        if seconds < size:
            return f"{max(1, math.ceil(seconds / {'s': 1, 'min': 60}[unit]))} {unit}"
    return f"{seconds / 3600:,.0f} h"


def _read_number(recorded: Mapping[str, Any], name: str) -> float:
    """Return a number of at least 0."""
    value = recorded.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value >= 0):
        why = " (the run found no failure)" if name == "cov" and value is None else ""
        raise BadInput(f"Expected a number {name} in the result of the run, got {reprlib.repr(value)}{why}.")
    return float(value)
