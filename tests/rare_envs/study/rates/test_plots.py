"""Pictures of risks: what is drawn where."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from rare_envs.exposure import TotalRate
from rare_envs.study.plots import draw_rates
from rare_envs.study.text import format_rate
from tests.rare_envs.exposure.test_rate import rate

pytestmark = pytest.mark.usefixtures("full_pictures")


def test_a_rate_with_an_upper_end_alone_is_an_arrow_without_a_point(tmp_path: Path) -> None:
    """The rates: one with an interval, one below its upper end, and their sum."""
    axes = Figure().subplots()
    total = TotalRate((rate(spread=1.4), rate(0.0, math.inf, upper=1e-3, scenario="hard_brake")))
    draw_rates(axes, total)
    dots = [float(line.get_ydata()[0]) for line in axes.lines if line.get_marker() == "o"]
    assert dots == [0.0, 2.0]
    arrows = [text for text in axes.texts if text.arrow_patch is not None]
    assert len(arrows) == 1
    high = total.rates[1].interval_per_million_km[1]
    assert (arrows[0].xyann, arrows[0].xy) == ((pytest.approx(high), 1), (pytest.approx(axes.get_xlim()[0]), 1))
    assert [text.get_text() for text in axes.texts if text.get_text()] == [f"below {format_rate(high)}"]
