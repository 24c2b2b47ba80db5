"""Safety measures: how close an episode came to a collision; small is dangerous, always finite."""

from rare_envs.measures.base import EpisodeMeasure, Measure, MeasureTerms, Moment, Trace, TraceMeasure
from rare_envs.measures.longitudinal import ttb, ttc
from rare_envs.measures.registry import MEASURES, find_measure, minimum, weighted, with_collision
from rare_envs.measures.temporal_logic import stl

__all__ = [
    "MEASURES",
    "EpisodeMeasure",
    "Measure",
    "MeasureTerms",
    "Moment",
    "Trace",
    "TraceMeasure",
    "find_measure",
    "minimum",
    "stl",
    "ttb",
    "ttc",
    "weighted",
    "with_collision",
]
