"""The registry of measures: by name, `module:measure`, or `stl:FORMULA`."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType
from typing import Any

from torch import Tensor

from rare_envs.measures.base import EpisodeMeasure, Measure, MeasureTerms
from rare_envs.measures.braking import (
    DECELERATION_MAX,
    MAX_BRAKING,
    btn,
    drac,
    evasive_manoeuvre,
    required_deceleration,
    ttb,
)
from rare_envs.measures.encroachment import pet
from rare_envs.measures.episode_trace import TraceMeasure
from rare_envs.measures.exposure import EXPOSURE_MAX, Exposure, tet, tit
from rare_envs.measures.moment import Moment
from rare_envs.measures.rss import MARGIN_MAX, rss_lateral, rss_longitudinal, rss_margin
from rare_envs.measures.temporal_logic import stl
from rare_envs.measures.time_to_collision import (
    AT_START,
    TTC_MAX,
    lidar_ttc,
    lidar_ttc_terms,
    mttc,
    name_edge_terms,
    name_lidar_terms,
    thw,
    ttc,
    ttc_terms,
)
from rare_envs.measures.two_dimensional import (
    CLEARANCE_MAX,
    EARLY_SHARE,
    clearance,
    clearance_terms,
    contact_time_terms,
    find_nearest_pair,
    find_vehicle_or_edge,
    margin,
    margin_terms,
    name_pairs,
    pair_clearance,
    pair_clearance_terms,
    ttc_2d,
)
from rare_envs.plugins import did_you_mean, import_object
from rare_envs.traffic.crash import crash_of

FORMULA = "stl:"


def load_measure(measure: Any) -> Any:
    """Return what a text such as "stl:FORMULA" or "module:name" stands for; `find_measure` takes what it returns.

    Args:
        measure: "stl:always (gap > 2)", a formula of signal temporal logic; "module:name", a function of a `Moment` or
            a measure in a module of the user's (those in the working directory are found); all else stays as it is.

    Raises:
        ValueError: The formula cannot be used, or the module has nothing of that name.
    """
    if not isinstance(measure, str) or ":" not in measure:
        return measure
    if measure.startswith(FORMULA):
        try:
            return stl(measure.removeprefix(FORMULA).strip())
        except ImportError as error:
            raise ValueError(str(error)) from error
    return import_object(measure, f"the measure {measure!r}")


def _negative_contact_speed(moment: Moment) -> Tensor:
    """Return the negative speed at which bodies meet in a collision [m/s], shape (B,)."""
    return -crash_of(moment.state, moment.road, moment.before, moment.dt).closing_speed


def _to_vehicles_and_edge(of: Callable[[Moment], Tensor]) -> MeasureTerms:
    """Return terms that are times to each other vehicle and to the edge of the road."""
    return MeasureTerms(of, find_vehicle_or_edge, name_edge_terms)


CLEARANCE = Measure(
    clearance,
    unit="m",
    terms=MeasureTerms(clearance_terms, cuts=(EARLY_SHARE,), unattained=CLEARANCE_MAX),
    collisions_only=True,
)
"""Distance to the nearest vehicle. A collision belongs to the vehicle that was hit, off the road to the nearest."""
PAIR_CLEARANCE = Measure(
    pair_clearance,
    unit="m",
    terms=MeasureTerms(
        pair_clearance_terms, find_nearest_pair, name_pairs, cuts=(EARLY_SHARE,), unattained=CLEARANCE_MAX
    ),
    collisions_only=True,
)
"""Distance of the two vehicles that are nearest to each other, the ego or not."""

MEASURES: MappingProxyType[str, EpisodeMeasure] = MappingProxyType(
    {
        "ttc": Measure(ttc, terms=_to_vehicles_and_edge(ttc_terms), collisions_only=True),
        "lidar_ttc": Measure(
            lidar_ttc,
            sees=True,
            collision=None,
            terms=MeasureTerms(lidar_ttc_terms, names=name_lidar_terms, cuts=(AT_START,), unattained=TTC_MAX),
        ),
        "ttc_2d": Measure(ttc_2d, terms=_to_vehicles_and_edge(contact_time_terms), collisions_only=True),
        "mttc": Measure(mttc, collisions_only=True),
        "thw": Measure(thw, collisions_only=True),
        "drac": Measure(drac, collision=-DECELERATION_MAX, critical=3.4, unit="m/s^2"),
        "required_deceleration": Measure(
            required_deceleration, collision=-DECELERATION_MAX, critical=MAX_BRAKING, unit="m/s^2"
        ),
        "btn": Measure(btn, collision=-DECELERATION_MAX, critical=1.0, unit=""),
        "near_crash": Measure(evasive_manoeuvre, collision=-DECELERATION_MAX, critical=1.0, unit=""),
        "ttb": Measure(ttb, collision=-TTC_MAX),
        "pet": TraceMeasure(pet, unit="s"),
        "rss_longitudinal": Measure(rss_longitudinal, collision=-MARGIN_MAX, unit="m"),
        "rss_lateral": Measure(rss_lateral, collision=-MARGIN_MAX, unit="m"),
        "rss_margin": Measure(rss_margin, collision=-MARGIN_MAX, unit="m"),
        "clearance": CLEARANCE,
        "tet": Exposure(tet, collision=-EXPOSURE_MAX, unit="s"),
        "tit": Exposure(tit, collision=-EXPOSURE_MAX, unit="s^2"),
        "margin": Measure(
            margin, collision=_negative_contact_speed, terms=_to_vehicles_and_edge(margin_terms), collisions_only=True
        ),
    }
)
"""Measures by name. Where large values are dangerous, f is the critical value less the value."""


def find_measure(measure: Any) -> EpisodeMeasure:
    """Return the measure that a keyword argument `measure` stands for.

    Args:
        measure: Name of one, a `Measure` or another `EpisodeMeasure`, or a function from a `Moment` of B scenarios to
            shape (B,): small is dangerous, the least over the moments counts, a collision counts as -1.

    Raises:
        ValueError: If it is none of these; an unknown name comes with the nearest known one.

    Example:
        >>> find_measure("drac").unit
        'm/s^2'
        >>> find_measure(lambda moment: moment.lead.gap).collision
        -1.0
    """
    if isinstance(measure, str) and measure in MEASURES:
        return MEASURES[measure]
    if not isinstance(measure, str | type):
        if isinstance(measure, EpisodeMeasure):
            return measure
        if callable(measure):
            return Measure(measure, unit="")
    hint = did_you_mean(measure, MEASURES) if isinstance(measure, str) else ""
    raise ValueError(
        f"Unknown measure {measure!r}{hint}; the measures are {', '.join(MEASURES)}, "
        "module:name, stl:FORMULA, or a function of a Moment (see docs/measures.md)."
    )
