"""Picture of what p is sensitive to."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

import samplers
from rare_envs.files import replace_file


def save_sensitivity(path: Path, sensitivity: samplers.Sensitivity) -> None:
    """Draw importance and derivatives as bars and save the picture.

    Args:
        path: `.png` to write.
        sensitivity: What to draw.
    """
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        # a Figure of its own, without pyplot: no window, no global state, whatever backend the user has
        figure = Figure(figsize=(14, 4.5), layout="constrained")
        sensitivity.plot(list(figure.subplots(1, 2)))
        with replace_file(path) as draft:
            figure.savefig(draft, dpi=120)
