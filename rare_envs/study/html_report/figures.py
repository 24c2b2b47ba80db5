"""Figures of the report, as SVG that stands in the page or as files."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rare_envs.files import replace_file
from rare_envs.study.plots import (
    HIT_COLOUR,
    LINE_COLOUR,
    ORDINARY_COLOUR,
    SEVERE,
    drawing,
    show_literally,
)
from rare_envs.study.text import Result
from samplers.analysis.curve import WIDEST_BAND
from samplers.problem import FloatArray

FORMATS = ("svg", "pdf", "png")
"""Of figures as files."""
Draw = Callable[[Figure], object]
"""Draws into an empty figure."""
Size = tuple[float, float]
"""Width and height [inch]."""


class FigureOfPage:
    """A figure of the page, drawn once for each format that is asked for."""

    def __init__(self, name: str, caption: str, draw: Draw, size: Size) -> None:
        self.name, self.caption, self._draw, self._size = name, caption, draw, size

    def to_svg(self) -> str:
        """Return it as an element of a page: it has the width of its place, and its text is text."""
        buffer = io.StringIO()
        with drawing(**{"svg.fonttype": "none", "svg.hashsalt": self.name}):
            self._make().savefig(buffer, format="svg", metadata={"Date": None})
        text = buffer.getvalue()
        text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
        for name in ("height", "width"):
            text = re.sub(rf'(<svg[^>]*?) {name}="[^"]*"', r"\1", text, count=1)
        # ids of matplotlib, such as figure_1, are the same in every figure
        text = re.sub(r'\bid="([^"]+)"', rf'id="{self.name}-\1"', text)
        text = re.sub(r'(xlink:href="#|href="#|url\(#)(?=[^)"])', rf"\g<1>{self.name}-", text)
        size = f"max-width:{110 * self._size[0]:.0f}px"  # no larger than with type of normal size
        label = html.escape(self.caption)
        return text.replace("<svg", f'<svg role="img" aria-label="{label}" style="{size}"', 1).strip()

    def save(self, folder: Path, kind: str) -> Path:
        """Save it as a file of a folder, and return its path."""
        path = folder / f"{self.name}.{kind}"
        with drawing(), replace_file(path) as draft:
            self._make().savefig(draft, dpi=150)
        return path

    def _make(self) -> Figure:
        figure = Figure(figsize=self._size, layout="constrained")
        self._draw(figure)
        show_literally(figure)
        return figure


PANEL_SIZE = (4.4, 3.0)
"""Size of a figure of one panel [inch]."""
MAX_HISTOGRAMS, PANELS = 12, 2
"""Parameters that are shown, those that failures shift most, and how many of them side by side."""


def draw_band(
    figure: Figure, curve: Mapping[str, Any], axis: str, words: tuple[str, str], gamma: float | None = None
) -> None:
    """Draw p of a curve and its simultaneous band over one of its entries, p on a log scale; words are on the axes."""
    axes = figure.subplots()
    over, p, low, high = (np.array(curve[name], dtype=float) for name in (axis, "p", "low", "high"))
    narrow = high <= WIDEST_BAND * low
    over = np.where(narrow | ~narrow.any(), over, np.nan)  # as far as the band says something to the eye
    floor = p[p > 0].min(initial=1.0) / 10  # an end of 0 has no place on a log scale
    band = f"{100 * float(curve['confidence']):g} % band, for all thresholds together"
    ends = (np.maximum(low, floor), np.maximum(high, floor))
    axes.fill_between(over, *ends, color=LINE_COLOUR, alpha=0.2, linewidth=0, label=band)
    axes.plot(over, np.where(p > 0, p, np.nan), color=LINE_COLOUR, label=words[1])
    axes.set(yscale="log", xlabel=words[0], ylabel=words[1])
    if gamma is not None:
        axes.axvline(gamma, color=HIT_COLOUR, linewidth=1, label="gamma")
        axes.legend(loc="lower right", frameon=False)


def figures_of_result(result: Result, measure: str, prefix: str = "") -> dict[str, FigureOfPage]:
    """Return the figures that the numbers of a run allow, by name; `prefix` stands before it in files and ids."""
    curve, severity = result.get("curve"), result.get("severity")
    drawn = dict[str, tuple[str, Draw]]()
    if isinstance(curve, dict):
        gamma = float(result["gamma"])
        words = (f"threshold of f{f', {measure}' if measure else ''}", "P[f ≤ threshold]")
        caption = "Probability over the threshold, with its band"
        drawn["curve"] = caption, lambda figure: draw_band(figure, curve, "gammas", words, gamma)
    if isinstance(severity, dict) and severity["largest_delta_v"] > SEVERE:
        over, axes = severity["curve"], ("delta-v [m/s]", "P[collision with a larger delta-v]")
        drawn["severity"] = "Severity of the collisions", lambda figure: draw_band(figure, over, "delta_v", axes)
    return {name: FigureOfPage(prefix + name, *about, PANEL_SIZE) for name, about in drawn.items()}


def figure_of_parameters(
    ordinary: FloatArray, failing: FloatArray, weights: FloatArray, labels: list[str], prefix: str = ""
) -> FigureOfPage:
    """Return a figure of each of k parameters in ordinary traffic (n, k) and among failures (m, k), weights (m,)."""
    rows = math.ceil(len(labels) / PANELS)

    def draw(figure: Figure) -> None:
        panels = np.atleast_1d(figure.subplots(rows, min(PANELS, len(labels)), squeeze=False)).ravel()
        for axes in panels[len(labels) :]:
            axes.set_axis_off()
        for label, axes, usual, failed in zip(labels, panels, ordinary.T, failing.T, strict=False):
            ends = [np.quantile(values, [0.002, 0.998]) for values in (usual, failed)]
            low, high = float(np.min(ends)), float(np.max(ends))
            bins = np.linspace(low, high, 30) if high > low else np.array([low - 0.5, low + 0.5])
            step: dict[str, Any] = {"label": "failures", "histtype": "step", "linewidth": 1.5, "weights": weights}
            axes.hist(usual, bins=bins, density=True, color=ORDINARY_COLOUR, label="ordinary traffic")
            axes.hist(failed, bins=bins, density=True, color=HIT_COLOUR, **step)
            axes.set(xlabel=label.replace("_", " "), yticks=[])
            axes.spines["left"].set_visible(False)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)

    caption = "Parameters in ordinary traffic and among failures, the most shifted first"
    return FigureOfPage(f"{prefix}parameters", caption, draw, (PANEL_SIZE[0], 0.4 + 1.9 * rows))
