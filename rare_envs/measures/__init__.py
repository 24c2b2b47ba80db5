"""Safety measures: how close an episode came to a collision; small is dangerous, always finite."""

from rare_envs.measures.base import COLLISION, EpisodeMeasure, Measure, MeasureTerms, Moment, Trace, TraceMeasure
from rare_envs.measures.longitudinal import (
    Exposure,
    btn,
    drac,
    lidar_ttc,
    mttc,
    required_deceleration,
    tet,
    thw,
    tit,
    ttb,
    ttc,
)
from rare_envs.measures.registry import MEASURES, find_measure, minimum, weighted, with_collision
from rare_envs.measures.temporal_logic import stl
from rare_envs.measures.two_dimensional import (
    RSS,
    clearance,
    margin,
    pet,
    rss_lateral,
    rss_longitudinal,
    rss_margin,
    ttc_2d,
)

__all__ = [
    "COLLISION",
    "MEASURES",
    "RSS",
    "EpisodeMeasure",
    "Exposure",
    "Measure",
    "MeasureTerms",
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
