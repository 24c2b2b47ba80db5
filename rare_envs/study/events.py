"""Events: the kinds of event that a scenario stands for, each with its rate beside that of people in the same event.

The strata of a traffic model are parts of p (`samplers.Estimate.parts`). Those that bear the name of an event of
which people's contacts were counted, such as the brakings to a standstill among all brakings, are events of their own;
the others are parts of the scenario's one event, such as the cutters who do not look. The rate of a part is the
frequency of the scenario's events times its share times its p, and its interval has the error of the share, as each
refit of the base has shares of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

import samplers
from rare_envs.exposure import CollisionRate
from rare_envs.people import Event, EventCalibration, HumanBenchmark, calibration, people_in
from rare_envs.scenarios.registry import complete_id, find_scenario
from samplers import analysis
from samplers.analysis.base_error import BaseUncertainty
from samplers.analysis.reweight import find_fitted_base, refit_quantile
from samplers.problem import read_strata

if TYPE_CHECKING:
    from rare_envs.study.question import Study

MODEL, NO_HEADWAY_RULE = "human", "human:no-headway-rule"
"""The human driver model, and the same whose glances may be longer than the headway; people need not lie between."""
COUNTED: tuple[str, ...] = get_args(Event)
"""Events of which people's contacts were counted."""


@dataclass(frozen=True, kw_only=True)
class EventRate:
    """Collisions of an ego in one kind of event."""

    event: str
    """One of `COUNTED`, or the name of a scenario."""
    rate: CollisionRate
    share: float
    """Share of the scenario's events that are of this kind."""
    parts: Mapping[str, float]
    """Shares of the rate by stratum; empty if there is one stratum, or nothing failed."""
    unresolved: Mapping[str, float] = field(default_factory=dict)
    """Upper limits of the rate [per million km] in strata that are not resolved, see `samplers.method.Part`; that of an
    event which is such a stratum under its own name."""
    traffic: str
    """The traffic model, and the options that make other traffic of it."""
    calibration: EventCalibration | None
    """The human driver model in this event and traffic; None if nobody has measured it."""

    @property
    def people(self) -> HumanBenchmark | None:
        """Contacts of people in the same event; None if nobody has counted them."""
        return count_people(self.event)

    @property
    def uncalibrated(self) -> str:
        """Why the rate is not calibrated: the human driver model misses people, or was not measured; empty if it is."""
        if self.calibration is None:
            return f"no calibration of {self.traffic}"
        return "" if self.calibration.is_calibrated else f"uncalibrated, {self.calibration.describe_factor()}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "event": self.event,
            "share_of_events": self.share,
            **self.rate.to_dict(),
            "parts": dict(self.parts),
            "unresolved": dict(self.unresolved),
            "people": None if self.people is None else self.people.to_dict(),
            "uncalibrated": self.uncalibrated,
            "calibration": None if self.calibration is None else self.calibration.to_dict(),
        }


def count_people(event: str) -> HumanBenchmark | None:
    """Return people's contacts in a kind of event; None if nobody has counted them."""
    return people_in(event).contacts if event in COUNTED else None  # type: ignore[arg-type]


def sum_people(events: Sequence[EventRate]) -> HumanBenchmark | None:
    """Return people's contacts in several kinds of event together; None if one of them was not counted."""
    return add_people([each.people for each in events])


def add_people(counted: Sequence[HumanBenchmark | None]) -> HumanBenchmark | None:
    """Return contacts of several kinds of event together; None if one of them was not counted."""
    known = [each for each in counted if each is not None]
    if not known or len(known) < len(counted):
        return None
    kinds = ", ".join(each.kind for each in known)
    return replace(known[0], count=sum(each.count for each in known), kind=kinds, words="sum of the kinds of event")


def describe_traffic(study: Study) -> str:
    """Return the traffic model of a study, and the options that make other traffic of it."""
    changed = [name for name in ("drivers", "horizon") if getattr(study.question, name) is not None]
    return f"{study.base_name} with {' and '.join(changed)}" if changed else study.base_name


def find_calibration(event: str, study: Study) -> EventCalibration | None:
    """Return the calibration of an event in the traffic of a study; None if nobody measured it.

    It is that of the newest version of the scenario: the scripts of earlier ones have drivers as there are none.
    """
    env_id = study.question.env_id
    newest = complete_id(find_scenario(env_id).name) == env_id.rpartition(":")[2]
    return calibration(event, describe_traffic(study)) if newest else None  # type: ignore[arg-type]


def bound_shares(estimate: samplers.Estimate) -> list[float]:
    """Return the upper limit of the share of each of `estimate.parts`: no more of the events can end in a collision.

    It is that of a log-normal share with the spread of the refits; the share itself if the base has none.
    """
    shares, fitted = [part.share for part in estimate.parts], find_fitted_base(estimate.base)
    if fitted is None or len(fitted.refits) < 2 or fitted.clusters < 2:
        return shares
    of_refits = np.array([[stratum.share for stratum in read_strata(refit)] for refit in fitted.refits])
    quantile = refit_quantile(estimate.confidence, len(of_refits) - 1, fitted.clusters)
    largest = shares * np.exp(quantile * np.log(of_refits).std(axis=0, ddof=1))
    return [float(each) for each in np.minimum(largest, 1.0)]


def list_part_errors(estimate: samplers.Estimate) -> list[BaseUncertainty | None]:
    """Return what the events behind the base leave open of share times p of each of `estimate.parts`, share included.

    None if nothing failed, or the base has no refits.
    """
    try:
        failures = analysis.weigh_failures(estimate)
    except ValueError:  # nothing failed, or p is no sum over points
        return [None] * len(estimate.parts)
    strata, found = read_strata(estimate.base), list[BaseUncertainty | None]()
    which = np.argmax([each.base.log_prob(failures.x) for each in strata], axis=0)  # densities are 0 in the others
    for number, part in enumerate(estimate.parts):
        here = (which == number).astype(np.float64)
        own = analysis.FailureExpectation(
            value=part.share * part.p,
            interval=(part.share * part.interval[0], part.share * part.interval[1]),
            confidence=estimate.confidence,
            cov=part.cov,
            per_failure=part.of_sum,
        )
        found.append(analysis.expect_under_refits(estimate, failures, here, own) if here.any() else None)
    return found
