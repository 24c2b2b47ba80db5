"""Sites: the base distribution of a site, and the rate at other sites over that at one's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike

from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.frequency import EventFrequency
from rare_envs.exposure.base_record import read_site
from rare_envs.exposure.rate import MILLION_KM
from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.study.evaluate import run
from rare_envs.study.question import Study, build_problem
from rare_envs.study.report import Report


def choose_base(scenario: Scenario, given: str | PathLike[str] | None, site: str) -> tuple[str, tuple[str, ...]]:
    """Return the base distribution of a scenario at a site, and notes on it.

    Where that of the site has no event frequency, it is the first one that has.

    Args:
        scenario: The scenario.
        given: Name or file that the user gave for it; None for the site's.
        site: Name of a base distribution.
    """
    if given is not None:
        return str(given), ()
    own = site if site in scenario.bases else next(iter(scenario.bases))
    found = (
        own if _has_frequency(scenario, own) else next((n for n in scenario.bases if _has_frequency(scenario, n)), own)
    )
    if found == site:
        return site, ()
    lack = "no event frequency at" if site in scenario.bases else "no base"
    return found, (f"it has {lack} {site!r}: {found!r} is used",)


def _has_frequency(scenario: Scenario, name: str) -> bool:
    base = load_base(scenario, name)
    return isinstance(base, FittedDistribution) and base.frequency is not None


def compare_sites(report: Report, sites: Sequence[str], progress: bool = False) -> dict[str, float]:
    """Return rates per km under the bases of other sites over that of a report, by name.

    They come from the simulations of the report, reweighted. Where these do not suffice, sites that are asked for are
    simulated, and others left out; all are left out where nothing failed.

    Args:
        report: With a rate.
        sites: Names of base distributions that are asked for; those that the scenario lacks are left out.
        progress: Show a bar on standard error.
    """
    study = report.study
    if report.estimate.p == 0 or report.rate is None:
        return {}
    factors = {}
    for name, frequency in _other_frequencies(study, sites).items():
        p = _estimate_under(report, name, name in sites, progress)
        if p > 0:
            factors[name] = p * frequency.per_km / report.rate.per_million_km * MILLION_KM
    return factors


def _other_frequencies(study: Study, sites: Sequence[str]) -> dict[str, EventFrequency]:
    """Return the frequencies of the bases that are asked for, and of the first base of each further site."""
    scenario = study.problem.world.scenario
    own = read_site(study.base.record) if isinstance(study.base, FittedDistribution) else ""
    seen, found = {own}, dict[str, EventFrequency]()
    for name in sorted(scenario.bases, key=lambda name: name not in sites):
        base = load_base(scenario, name)
        if name == study.base_name or not isinstance(base, FittedDistribution) or base.frequency is None:
            continue
        site = read_site(base.record)
        if name in sites or site not in seen:
            found[name] = base.frequency
        seen.add(site)
    return found


def _estimate_under(report: Report, name: str, asked: bool, progress: bool) -> float:
    """Return p under another base; NaN where the simulations do not give it and it was not asked for."""
    study = report.study
    question = replace(study.question, base=name)
    problem = build_problem(question, study.problem.ego)
    try:
        return report.estimate.reweight(problem.base).p
    except ValueError:
        return run(replace(study, question=question, problem=problem), progress).estimate.p if asked else math.nan
