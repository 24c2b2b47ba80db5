"""Pictures of risks: what is drawn where."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from rare_envs.exposure import TotalRate
from rare_envs.study.plots import draw_rates, draw_shares, save_risk_plot
from rare_envs.study.text import format_rate
from tests.rare_envs.exposure.test_rate import rate

pytestmark = pytest.mark.usefixtures("full_pictures")

TOTAL = TotalRate((rate(spread=1.4), rate(1e-4, scenario="hard_brake", spread=1.0)))
UNKNOWN = TotalRate((rate(0.0, math.inf, upper=1e-3),))


def test_intervals_and_rates_stand_at_their_places() -> None:
    axes = Figure().subplots()
    draw_rates(axes, TOTAL)
    bars = [line for line in axes.lines if line.get_linewidth() == 3]
    assert [tuple(bar.get_xdata()) for bar in bars] == [
        *(pytest.approx(each.interval_per_million_km) for each in TOTAL.rates),
        pytest.approx(TOTAL.interval_per_million_km),
    ]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["cut-in", "hard brake", "total"]
    people = sorted(float(line.get_xdata()[0]) for line in axes.lines if line.get_color() == "black")
    assert people == pytest.approx([4.35, 21.1], rel=0.01)


def test_bars_are_the_shares() -> None:
    axes = Figure().subplots()
    draw_shares(axes, TOTAL)
    assert [patch.get_width() for patch in axes.patches] == pytest.approx([100 * each.share for each in TOTAL.shares])


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


def test_where_nothing_failed_the_picture_says_so(tmp_path: Path) -> None:
    axes = Figure().subplots()
    draw_rates(axes, UNKNOWN)
    assert axes.get_xlim()[0] < UNKNOWN.interval_per_million_km[1] < axes.get_xlim()[1]
    shares = Figure().subplots()
    draw_shares(shares, UNKNOWN)
    assert [text.get_text() for text in shares.texts] == ["not known: no rate has a lower end"]
    save_risk_plot(tmp_path / "risk.png", "idm", UNKNOWN)
    assert (tmp_path / "risk.png").read_bytes()[:4] == b"\x89PNG"
