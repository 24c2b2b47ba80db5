"""Trainings of the shipped egos, and the evaluation of egos in ordinary traffic.

The names are imported on first use: the modules are programs too, and need seconds to load.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

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
    "Summary": "nominal_driving",
    "Verdicts": "nominal_driving",
    "VisionConfig": "vision",
    "judge": "nominal_driving",
    "summarise_verdicts": "nominal_driving",
    "train_imitation_ego": "imitation",
    "train_vision_ego": "vision",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
