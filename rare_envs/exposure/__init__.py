"""Exposure: from a probability per event to collisions per hour and per kilometre, beside those of human drivers."""

from rare_envs.exposure.human_benchmarks import (
    HUMAN_BENCHMARKS,
    HumanBenchmark,
    describe_human_contacts,
    summarise_human_contacts,
)
from rare_envs.exposure.rate import CollisionProbability, CollisionRate, LogVariance
from rare_envs.exposure.total_rate import FurtherEvents, TotalRate, VarianceShare

__all__ = [
    "HUMAN_BENCHMARKS",
    "CollisionProbability",
    "CollisionRate",
    "FurtherEvents",
    "HumanBenchmark",
    "LogVariance",
    "TotalRate",
    "VarianceShare",
    "describe_human_contacts",
    "summarise_human_contacts",
]
