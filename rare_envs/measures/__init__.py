"""Safety measures: how close an episode came to a collision; small is dangerous, always finite."""

from types import MappingProxyType
from typing import Any

from torch import Tensor

from rare_envs.crashes import crash_of
from rare_envs.measures.base import COLLISION, EpisodeMeasure, Measure
from rare_envs.measures.braking import BRAKES, DECELERATION_MAX, btn, drac, required_deceleration, ttb
from rare_envs.measures.combine import Combined, minimum, weighted, with_collision
from rare_envs.measures.encroachment import PET_MAX, pet
from rare_envs.measures.exposure import EXPOSURE_MAX, TTC_CRITICAL, Exposure, tet, tit
from rare_envs.measures.following import TTC_MAX, lidar_ttc, mttc, thw, ttc
from rare_envs.measures.moment import Moment
from rare_envs.measures.rss import MARGIN_MAX, RSS, rss_lateral, rss_longitudinal, rss_margin
from rare_envs.measures.space import clearance, margin, ttc_2d
from rare_envs.measures.temporal import SIGNALS, stl
from rare_envs.measures.trace import Trace, TraceMeasure
from rare_envs.space import did_you_mean

__all__ = [
    "BRAKES",
    "COLLISION",
    "DECELERATION_MAX",
    "EXPOSURE_MAX",
    "MARGIN_MAX",
    "MEASURES",
    "PET_MAX",
    "RSS",
    "SIGNALS",
    "TTC_CRITICAL",
    "TTC_MAX",
    "Combined",
    "EpisodeMeasure",
    "Exposure",
    "Measure",
    "Moment",
    "Trace",
    "TraceMeasure",
    "btn",
    "clearance",
    "drac",
    "find_measure",
    "lidar_ttc",
    "margin",
    "minimum",
    "mttc",
    "pet",
    "required_deceleration",
    "rss_lateral",
    "rss_longitudinal",
    "rss_margin",
    "stl",
    "tet",
    "thw",
    "tit",
    "ttb",
    "ttc",
    "ttc_2d",
    "weighted",
    "with_collision",
]


def _met_at(moment: Moment) -> Tensor:
    """The negative speed at which bodies meet in a collision [m/s], shape (B,)."""
    return -crash_of(moment.state, moment.road, moment.before, moment.dt).closing_speed


MEASURES: MappingProxyType[str, EpisodeMeasure] = MappingProxyType(
    {
        "ttc": Measure(ttc),
        "lidar_ttc": Measure(lidar_ttc, sees=True, collision=None),
        "ttc_2d": Measure(ttc_2d),
        "mttc": Measure(mttc),
        "thw": Measure(thw),
        "drac": Measure(drac, collision=-DECELERATION_MAX, critical=3.4, unit="m/s^2"),
        "required_deceleration": Measure(
            required_deceleration, collision=-DECELERATION_MAX, critical=BRAKES, unit="m/s^2"
        ),
        "btn": Measure(btn, collision=-DECELERATION_MAX, critical=1.0, unit=""),
        "ttb": Measure(ttb, collision=-TTC_MAX),
        "pet": TraceMeasure(pet, unit="s"),
        "rss_longitudinal": Measure(rss_longitudinal, collision=-MARGIN_MAX, unit="m"),
        "rss_lateral": Measure(rss_lateral, collision=-MARGIN_MAX, unit="m"),
        "rss_margin": Measure(rss_margin, collision=-MARGIN_MAX, unit="m"),
        "clearance": Measure(clearance, unit="m"),
        "tet": Exposure(tet, collision=-EXPOSURE_MAX, unit="s"),
        "tit": Exposure(tit, collision=-EXPOSURE_MAX, unit="s^2"),
        "margin": Measure(margin, collision=_met_at),
    }
)
"""Measures by name. Where large values are dangerous, f is the critical value less the value."""


def find_measure(measure: Any) -> EpisodeMeasure:
    """The measure that a keyword argument `measure` stands for.

    Args:
        measure: Name of one, a `Measure` or another object with its methods, or a function from a `Moment` of B
            scenarios to shape (B,): small is dangerous, the least over the moments counts, a collision counts as -1.

    Raises:
        ValueError: If it is none of these; an unknown name comes with the nearest known one.
    """
    if isinstance(measure, str) and measure in MEASURES:
        return MEASURES[measure]
    if not isinstance(measure, str | type):
        if all(callable(getattr(measure, name, None)) for name in ("begin", "fold", "f")):
            found: EpisodeMeasure = measure
            return found
        if callable(measure):
            return Measure(measure, unit="")
    hint = did_you_mean(measure, MEASURES) if isinstance(measure, str) else ""
    raise ValueError(
        f"Unknown measure {measure!r}{hint}; the measures are {', '.join(MEASURES)}, "
        "module:name, stl:FORMULA, or a function of a Moment (see docs/measures.md)."
    )
