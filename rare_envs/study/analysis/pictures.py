"""Pictures of the analyses: what p is sensitive to, and how severe the collisions are."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

import samplers
from rare_envs.study.analysis.severity import Severity
from rare_envs.study.plots import STYLE, save_figure


def save_sensitivity(path: Path, sensitivity: samplers.Sensitivity) -> None:
    """Draw importance and derivatives as bars and save the picture.

    Args:
        path: `.png` to write.
        sensitivity: What to draw.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(14, 4.5), layout="constrained")
        sensitivity.plot(list(figure.subplots(1, 2)))
        save_figure(path, figure)


def save_severity(path: Path, severity: Severity) -> None:
    """Draw the curve of delta-v with its bands and save the picture.

    Args:
        path: `.png` to write.
        severity: What to draw.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7, 4.5), layout="constrained")
        severity.plot(figure.subplots())
        save_figure(path, figure)
