"""Trainings of the shipped egos, and the evaluation of egos in ordinary traffic.

The names are imported on first use: the modules are programs too, and need seconds to load.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from training.egos.imitation import train_imitation_ego
    from training.egos.nominal_driving import Summary, Verdicts, judge, summarise_verdicts
    from training.egos.vision import VisionConfig, train_vision_ego

__all__ = [
    "Summary",
    "Verdicts",
    "VisionConfig",
    "judge",
    "summarise_verdicts",
    "train_imitation_ego",
    "train_vision_ego",
]

_LAZY = {
    "Summary": "training.egos.nominal_driving",
    "Verdicts": "training.egos.nominal_driving",
    "VisionConfig": "training.egos.vision",
    "judge": "training.egos.nominal_driving",
    "summarise_verdicts": "training.egos.nominal_driving",
    "train_imitation_ego": "training.egos.imitation",
    "train_vision_ego": "training.egos.vision",
}

__getattr__ = make_lazy_getattr(__name__, _LAZY)
