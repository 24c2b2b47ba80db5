"""Risk: collisions of an ego per hour and per million km over scenarios that count nothing twice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from rare_envs.files import replace_text
from rare_envs.json_text import format_json
from rare_envs.scenarios.registry import env_id_of, scenario_named
from rare_envs.study.collision_rate import find_frequency
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.study.evaluate import run, run_into
from rare_envs.study.execution.interruption import RunInterrupted, keep_answer
from rare_envs.study.question import Question, Study, prepare
from rare_envs.study.rates.result import Risk, ScenarioRisk
from rare_envs.study.rates.sites import check_sites, choose_base, compare_sites
from rare_envs.study.run_directory import check_no_results

SCENARIO_SET = ("cut_in", "hard_brake")
"""Scenarios that count nothing twice."""
TWICE = ("cut_in", "car_following")
"""Scenarios of which a set may have one: a cut-in gives the ego a new leader, so that car-following behind new leaders
contains the cut-ins."""


def risk(
    ego: Any,
    *,
    scenarios: Sequence[str] = SCENARIO_SET,
    sites: str | Sequence[str] = ("us101",),
    bases: Mapping[str, str | PathLike[str]] | None = None,
    out: str | PathLike[str] | None = None,
    progress: bool = False,
    force: bool = False,
    **options: Any,
) -> Risk:
    """Estimate the collisions of an ego per million km, with an interval that holds what is not known of traffic.

    Each scenario's p is multiplied by the frequency of its events, and the products are added. The interval holds the
    errors of the counted events, of the fitted base distributions and of the simulations; with several `sites` also
    the spread between them. All holds for an ego that takes over at the moment of each event.

    Args:
        ego: Its name, file or address, as for `agents.load_ego`; or an object, as for `DrivingProblem`.
        scenarios: Names of scenarios that count nothing twice; car_following may stand in place of cut_in.
        sites: Names of sites, each that of the first base fitted to events of it, such as "us101": the bases of the
            first are used, and the spread of the rate between it and the others is part of the interval. Each
            scenario must have a base of the first site, or one in `bases`.
        bases: Base distributions, names or JSON files, by scenario, in place of those of the first site.
        out: Folder for the picture, the numbers and a folder of each scenario, see `rare-envs risk --out`.
        progress: Show a bar on standard error.
        force: Replace runs that the folder has, finished or not.
        **options: Further fields of `rare_envs.study.Question`: seed, max_sim (of each scenario), method, and so on.

    Raises:
        BadInput: An argument cannot be used; a scenario has no frequency of its events; or the ego failed.
        RunInterrupted: It was interrupted; the message says what is known.

    Example:
        >>> risk("idm", scenarios=("cut_in", "car_following"))
        Traceback (most recent call last):
            ...
        rare_envs.study.errors.BadInput: Expected one of cut_in, car_following: a cut-in is a new leader, and would count twice.
    """  # noqa: E501 (the example shows a whole message)
    sites = (sites,) if isinstance(sites, str) else sites
    _check_scenarios(scenarios, sites, bases or {})
    with as_bad_input(ValueError):
        chosen = {name: choose_base(scenario_named(name), (bases or {}).get(name), sites[0]) for name in scenarios}
    prepared = []
    for name in scenarios:
        base, notes = chosen[name]
        study = _prepare(ego, name, base, options)
        with as_bad_input(ValueError):
            find_frequency(study)
        prepared.append((study, notes))
    folder = None if out is None else Path(out)
    if folder is not None and not force:
        for name in scenarios:  # all of them, before the first one is run
            check_no_results(folder / name)
    done: list[ScenarioRisk] = []
    for study, notes in prepared:
        try:
            done.append(_evaluate(study, notes, sites[1:], folder, progress, force))
        except RunInterrupted as error:
            raise RunInterrupted(f"{error}{_describe_done(done)}", error.report) from None
    found = Risk(ego=ego if isinstance(ego, str) else type(ego).__name__, scenarios=tuple(done))
    if folder is not None:
        write_risk(folder, found)
    return found


def write_risk(folder: Path, found: Risk) -> None:
    """Write risk.json and risk.png into an existing folder."""
    replace_text(folder / "risk.json", format_json(found.to_dict()) + "\n")
    found.save_plot(folder / "risk.png")


def _describe_done(done: Sequence[ScenarioRisk]) -> str:
    """Return what is known of scenarios whose runs are done, behind a space; empty if there are none."""
    return f" Done before: {'; '.join(' '.join(one.describe().split()) for one in done)}." if done else ""


def _check_scenarios(scenarios: Sequence[str], sites: Sequence[str], bases: Mapping[str, Any]) -> None:
    """Raise a BadInput unless the scenarios exist, count nothing twice, and have bases of these sites."""
    with as_bad_input(ValueError):
        known = [scenario_named(name) for name in scenarios]
    if not scenarios or len(set(scenarios)) < len(scenarios):
        raise BadInput(f"Expected one or more different scenarios, got {', '.join(scenarios) or 'none'}.")
    if set(TWICE) <= set(scenarios):
        raise BadInput(f"Expected one of {', '.join(TWICE)}: a cut-in is a new leader, and would count twice.")
    if not sites:
        raise BadInput("Expected one site or more, such as us101.")
    with as_bad_input(ValueError):
        check_sites(known, sites)
    for name in bases:
        if name not in scenarios:
            raise BadInput(f"A base is given for {name!r}, which is none of {', '.join(scenarios)}.")


def _prepare(ego: Any, name: str, base: str, options: Mapping[str, Any]) -> Study:
    """Return the study of one scenario."""
    named = isinstance(ego, str)
    try:
        question = Question(env_id=env_id_of(name), ego=ego if named else type(ego).__name__, base=base, **options)
    except TypeError as error:
        raise BadInput(f"Cannot use an option of risk: {error}") from error
    return prepare(question, None if named else ego)


def _evaluate(
    study: Study, notes: tuple[str, ...], other_sites: Sequence[str], folder: Path | None, progress: bool, force: bool
) -> ScenarioRisk:
    """Run one scenario and return its rate, with the spread between sites if there are others."""
    name = study.problem.world.scenario.name
    report = run(study, progress) if folder is None else run_into(folder / name, study, progress, force)
    assert report.rate is not None  # `risk` has looked for the frequency before
    with keep_answer(report):
        factors = compare_sites(report, other_sites, progress)
    logs = [0.0, *(float(np.log(factors[site])) for site in other_sites if factors.get(site, 0) > 0)]
    spread = float(np.std(logs, ddof=1)) if len(logs) > 1 else 0.0
    return ScenarioRisk(
        report=report,
        rate=replace(report.rate, site_log_sd=spread),
        site_factors=factors,
        notes=(*notes, *report.notes),
    )
