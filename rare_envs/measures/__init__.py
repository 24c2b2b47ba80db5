"""Safety measures: how close an episode came to a collision; small is dangerous, always finite."""

from rare_envs.measures.base import COLLISION, EpisodeMeasure, Measure, MeasureTerms
from rare_envs.measures.braking import (
    DECELERATION_MAX,
    MAX_BRAKING,
    btn,
    drac,
    evasive_manoeuvre,
    required_deceleration,
    ttb,
)
from rare_envs.measures.combination import Combined, minimum, weighted, with_collision
from rare_envs.measures.encroachment import PET_MAX, pet
from rare_envs.measures.episode_trace import Trace, TraceMeasure
from rare_envs.measures.exposure import EXPOSURE_MAX, TTC_CRITICAL, Exposure, tet, tit
from rare_envs.measures.moment import Moment
from rare_envs.measures.registry import MEASURES, find_measure
from rare_envs.measures.rss import MARGIN_MAX, RSS, rss_lateral, rss_longitudinal, rss_margin
from rare_envs.measures.temporal_logic import SIGNALS, stl
from rare_envs.measures.time_to_collision import TTC_MAX, lidar_ttc, mttc, thw, ttc
from rare_envs.measures.two_dimensional import clearance, margin, ttc_2d

__all__ = [
    "COLLISION",
    "DECELERATION_MAX",
    "EXPOSURE_MAX",
    "MARGIN_MAX",
    "MAX_BRAKING",
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
    "MeasureTerms",
    "Moment",
    "Trace",
    "TraceMeasure",
    "btn",
    "clearance",
    "drac",
    "evasive_manoeuvre",
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
