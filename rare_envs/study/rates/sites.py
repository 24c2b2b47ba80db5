"""Sites: the base distribution of a site, and the rate at other sites over that at one's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from os import PathLike

from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.frequency import EventFrequency
from rare_envs.distributions.space import Distribution
from rare_envs.exposure.base_record import read_site
from rare_envs.exposure.rate import MILLION_KM
from rare_envs.plugins import did_you_mean
from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.study.evaluate import run
from rare_envs.study.question import Study
from rare_envs.study.report import Report


def list_sites(scenario: Scenario) -> dict[str, str]:
    """Return the sites of a scenario: the name of the first base of each, and the site in words.

    Further bases of a site are other families for the same events, no other site; an assembled base has none.
    """
    found: dict[str, str] = {}
    for name in scenario.bases:
        site = _read_site_of(load_base(scenario, name))
        if site and site not in found.values():
            found[name] = site
    return found


def check_sites(scenarios: Sequence[Scenario], sites: Sequence[str]) -> None:
    """Raise a ValueError unless sites are different ones, each of a scenario at least."""
    if not sites or len(set(sites)) < len(sites):
        raise ValueError(f"Expected one site or more, such as us101, each once; got {', '.join(sites) or 'none'}.")
    known = {name for scenario in scenarios for name in list_sites(scenario)}
    for site in (each for each in sites if each not in known):
        owner = next((scenario for scenario in scenarios if site in scenario.bases), None)
        if owner is None:
            names = ", ".join(scenario.name for scenario in scenarios)
            hint = did_you_mean(site, known)
            raise ValueError(f"No base of {names} is of a site {site!r}{hint}; there are {', '.join(sorted(known))}.")
        place = _read_site_of(load_base(owner, site))
        further = f"is a further base of the site {_name_of(owner, place)!r}" if place else "has no site"
        raise ValueError(
            f"{site!r} is no site: this base of {owner.name} {further}. The sites are {', '.join(sorted(known))}; "
            f"--base {owner.name}={site} takes it as the base."
        )


def choose_base(scenario: Scenario, given: str | PathLike[str] | None, site: str) -> tuple[str, tuple[str, ...]]:
    """Return the base distribution of a scenario at a site, and notes on it.

    Where that of the site has no event frequency, it is the first one that has, as the notes say.

    Args:
        scenario: The scenario.
        given: Name or file that the user gave for it; None for the site's.
        site: Name of a site.

    Raises:
        ValueError: The scenario has no base of the site. A sum of rates at different sites is that of no road.
    """
    if given is not None:
        return str(given), ()
    sites = list_sites(scenario)
    if site not in sites:
        raise ValueError(
            f"{scenario.name} has no base of the site {site!r} (it has {', '.join(sites) or 'none'}): "
            f"--base {scenario.name}={scenario.default_base} takes another one."
        )
    if _has_frequency(scenario, site):
        return site, ()
    found = next((name for name in scenario.bases if _has_frequency(scenario, name)), site)
    return found, () if found == site else (f"it has no event frequency at {site!r}: {found!r} is used",)


def _has_frequency(scenario: Scenario, name: str) -> bool:
    base = load_base(scenario, name)
    return isinstance(base, FittedDistribution) and base.frequency is not None


def compare_sites(report: Report, sites: Sequence[str], progress: bool = False) -> dict[str, float]:
    """Return rates per km at other sites over that of a report, by name.

    They come from the simulations of the report, reweighted. Where these do not suffice, sites that are asked for are
    simulated, and others left out; all are left out where nothing failed.

    Args:
        report: With a rate.
        sites: Names of sites that are asked for; those that the scenario lacks are left out.
        progress: Show a bar on standard error.
    """
    study = report.study
    if report.estimate.p == 0 or report.rate is None:
        return {}
    factors = {}
    for name, frequency in _other_frequencies(study).items():
        p = _estimate_under(report, name, name in sites, progress)
        if p > 0:
            factors[name] = p * frequency.per_km / report.rate.per_million_km * MILLION_KM
    return factors


def _other_frequencies(study: Study) -> dict[str, EventFrequency]:
    """Return the frequencies of the events at each other site, by its name, as far as they were counted."""
    scenario = study.problem.world.scenario
    own = _read_site_of(study.base)
    found = {}
    for name, site in list_sites(scenario).items():
        base = load_base(scenario, name)
        if site != own and isinstance(base, FittedDistribution) and base.frequency is not None:
            found[name] = base.frequency
    return found


def _read_site_of(base: Distribution) -> str:
    """Return the site of a base distribution in words; empty where it was not fitted to events of one."""
    return read_site(base.record) if isinstance(base, FittedDistribution) else ""


def _name_of(scenario: Scenario, place: str) -> str:
    """Return the name of a site of a scenario."""
    return next(name for name, site in list_sites(scenario).items() if site == place)


def _estimate_under(report: Report, name: str, asked: bool, progress: bool) -> float:
    """Return p under another base; NaN where the simulations do not give it and it was not asked for."""
    other = report.study.under(name)
    try:
        return report.estimate.reweight(other.problem.base).p
    except ValueError:
        return run(other, progress).estimate.p if asked else math.nan
