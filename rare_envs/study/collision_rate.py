"""Rates of collisions and injuries of an evaluation: per event, times the frequency of the events of its base."""

from __future__ import annotations

import math
from dataclasses import replace

import samplers
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.frequency import EventFrequency
from rare_envs.exposure.base_record import explain_no_frequency, read_source
from rare_envs.exposure.rate import CollisionProbability, CollisionRate
from rare_envs.measures.base import Measure
from rare_envs.measures.registry import MEASURES
from rare_envs.scenarios.registry import find_scenario
from rare_envs.study.analysis.severity import Severity
from rare_envs.study.question import Question, Study
from samplers.analysis.base_uncertainty import FIT_BIAS
from samplers.statistics.intervals import Interval
from samplers.statistics.refit_families import refit_quantile

COLLISION_MEASURE = "ttc"
"""The measure to advise: -1 after a collision and above 0 without one."""


def find_frequency(study: Study) -> EventFrequency:
    """Return the frequency of the events whose failures a question counts.

    Raises:
        ValueError: p is no probability of a collision per event, or nobody counted the events.
    """
    reason = _explain_no_collisions(study.question)
    if reason:
        raise ValueError(f"no rate per hour or km: {reason}")
    frequency = study.base.frequency if isinstance(study.base, FittedDistribution) else None
    if frequency is None:
        scenario = find_scenario(study.question.env_id).name
        record = study.base.record if isinstance(study.base, FittedDistribution) else {}
        raise ValueError(
            f"no rate per hour or km: the base {study.base_name!r} of {scenario} has no event frequency, "
            f"{explain_no_frequency(record)}"
        )
    return frequency


def compute_rate(study: Study, estimate: samplers.Estimate) -> CollisionRate:
    """Return the rate of collisions of an estimate.

    Args:
        study: The question, loaded.
        estimate: Its answer.

    Raises:
        ValueError: As in `find_frequency`.
    """
    return CollisionRate(
        scenario=study.problem.world.scenario.name,
        probability=describe_probability(estimate),
        frequency=find_frequency(study),
        confidence=estimate.confidence,
        fitted_to=_identify_events(study),
    )


def compute_injury_rate(study: Study, estimate: samplers.Estimate, severity: Severity) -> CollisionRate:
    """Return the rate of serious injuries (MAIS 3 or more) of an estimate: injuries per event in place of p.

    Args:
        study: The question, loaded.
        estimate: Its answer.
        severity: Of the collisions.

    Raises:
        ValueError: As in `find_frequency`.
    """
    injuries = severity.injuries
    probability = _describe_value(injuries.value, injuries.cov, injuries.interval, severity.injuries_base)
    return replace(compute_rate(study, estimate), probability=probability)


def describe_probability(estimate: samplers.Estimate) -> CollisionProbability:
    """Return p of an estimate with its errors: that of sampling, and where refits are known, that of the base."""
    return _describe_value(estimate.p, estimate.cov, estimate.interval, estimate.base_uncertainty)


def _describe_value(
    value: float, cov: float, sampling: Interval, base: samplers.BaseUncertainty | None
) -> CollisionProbability:
    """Return an expectation per event with its errors; its interval is that of the base where there is one."""
    known = value > 0 and math.isfinite(cov)
    if not known or base is None or not math.isfinite(base.spread):
        interval = sampling if known else None
        return CollisionProbability(p=value, cov=cov, upper=sampling[1], determined=known, interval=interval)
    return CollisionProbability(
        p=value,
        cov=cov,
        upper=sampling[1] if base.bound is None else base.bound,
        interval=base.interval,
        spread=base.spread,
        fit_bias=FIT_BIAS,
        quantile=refit_quantile(base.confidence, len(base.p_refits) - 1, base.clusters),
        determined=base.bound is None,
    )


def describe_left_out(study: Study, estimate: samplers.Estimate) -> tuple[str, ...]:
    """Return which errors the interval of the rate leaves out, and why there is no lower end; empty if it holds all.

    Args:
        study: The question, loaded.
        estimate: Its answer.
    """
    base, found = estimate.base_uncertainty, []
    if study.question.ensemble:
        mean = "ensemble: p is the mean over the refits, which stands for the error of the base distribution"
        found.append(f"{mean}; no interval of that error is given, and that of the rate leaves it out")
    if estimate.p == 0:
        why = "no failure counts in p" if estimate.failures.total else "nothing failed"
        found.append(f"{why}: the upper end is that of the simulations, without the error of the distribution")
    elif base is None:
        if not found:  # the mixture of the refits has none of its own
            found.append("the error of the base distribution is not known (no refits), and left out of the rate")
    elif base.bound is not None:
        found.append(f"the events do not determine p (spread {base.spread:.1f}): the rate has an upper end only")
    elif base.reason:
        found.append(f"the error of the base distribution is left out of the rate: {base.reason}")
    return tuple(found)


def _explain_no_collisions(question: Question) -> str:
    """Return why p is no probability of a collision of the ego; empty if it is one."""
    measure = MEASURES.get(question.measure)
    if not (isinstance(measure, Measure) and measure.collisions_only):
        return f"--measure {question.measure} counts other events than collisions (--measure {COLLISION_MEASURE} does)"
    lowest = measure.collision if isinstance(measure.collision, float) else 0.0  # no number: f is graded by the crash
    if not lowest <= question.gamma <= 0:
        return f"--gamma {question.gamma:g} counts other events than collisions (--gamma 0 does)"
    if question.collisions != "ego":
        return f"--collisions {question.collisions} counts those between other vehicles too"
    return ""


def _identify_events(study: Study) -> str:
    """Return words that two base distributions share if they were fitted to the same events; empty if not known."""
    base = study.base
    data = read_source(base.record)["data"] if isinstance(base, FittedDistribution) else ""
    return f"{base.fitted_to}, {data}" if isinstance(base, FittedDistribution) and data else ""
