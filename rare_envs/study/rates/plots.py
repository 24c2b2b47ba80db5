"""Picture of a risk: rates with their intervals beside those of people, and what the uncertainty comes from."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rare_envs.exposure.human_benchmarks import CONTACTS_100CAR, REAR_END_CONTACTS_100CAR
from rare_envs.exposure.rate import RateInterval
from rare_envs.exposure.total_rate import TotalRate
from rare_envs.study.plots import HIT_COLOUR, LINE_COLOUR, ORDINARY_COLOUR, STYLE, save_figure
from rare_envs.study.rates.text import format_rate, format_share, format_with_interval, name_scenario, name_source

FRACTION_BELOW = 0.1
"""Left end of the axis over the smallest number on it, where an interval reaches down to 0."""


def save_risk_plot(path: Path, ego: str, total: TotalRate) -> None:
    """Draw a total and the rates of which it is the sum, and save it.

    Args:
        path: `.png` to write.
        ego: The ego, for the title.
        total: The rates.
    """
    with matplotlib.rc_context(STYLE):
        height = 1.6 + 0.45 * max(len(total.rates) + 1, len(total.shares))
        figure = Figure(figsize=(12, height), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
        figure.suptitle(
            f"ego {ego}: "
            + format_with_interval(
                total.per_million_km,
                total.interval_per_million_km,
                " collisions per million km",
                f"{100 * total.confidence:g} %: ",
            ),
            fontsize=12,
            fontweight="bold",
        )
        draw_rates(left, total)
        draw_shares(right, total)
        save_figure(path, figure)


def draw_rates(axes: Axes, total: TotalRate) -> None:
    """Draw the rate of each scenario and their sum, with intervals, and lines for people."""
    rows: list[tuple[str, float, RateInterval]] = [
        (name_scenario(rate.scenario), rate.per_million_km, rate.interval_per_million_km) for rate in total.rates
    ]
    rows.append(("total", total.per_million_km, total.interval_per_million_km))
    people = (CONTACTS_100CAR, REAR_END_CONTACTS_100CAR)
    shown = [end for _, _, ends in rows for end in ends if end > 0]
    start = FRACTION_BELOW * min(*shown, people[1].per_million_km)
    for row, (name, rate, (low, high)) in enumerate(rows):
        colour = HIT_COLOUR if name == "total" else LINE_COLOUR
        if low > 0:
            axes.plot([low, high], [row, row], color=colour, linewidth=3, alpha=0.5, solid_capstyle="butt")
            axes.plot(rate, row, "o", color=colour)
        else:  # an upper end alone: an arrow out of the axis, without a point
            style = {"arrowstyle": "->", "color": colour, "linewidth": 2}
            axes.annotate("", (start, row), (high, row), arrowprops=style)
            axes.plot(high, row, "|", color=colour, markersize=12, markeredgewidth=2)
            axes.annotate(f"below {format_rate(high)}", (high, row), (6, -3), textcoords="offset points", fontsize=8)
    axes.set_xscale("log")
    axes.set_xlim(start, max(*shown, people[0].per_million_km) / FRACTION_BELOW)
    for each, dashes in zip(people, ("--", ":"), strict=True):
        axes.axvline(each.per_million_km, color="black", linewidth=1, linestyle=dashes, label=each.kind)
    axes.set_yticks(range(len(rows)), [name for name, _, _ in rows])
    axes.set_ylim(len(rows) + 0.4, -0.6)  # room for the legend below
    axes.set_xlabel("collisions per million km")
    axes.legend(title="people (100-Car)", loc="lower left", fontsize=8, frameon=False)


def draw_shares(axes: Axes, total: TotalRate) -> None:
    """Draw the shares of the sources of the uncertainty as bars."""
    shares = total.shares
    of_what = "" if len(total.determined) == len(total.rates) else " of the determined part"
    axes.set_title(f"sources of the uncertainty{of_what}\n(shares of the variance)", fontsize=10)
    if not shares:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "not known: no rate has a lower end", ha="center", va="center", transform=axes.transAxes)
        return
    axes.barh(range(len(shares)), [100 * each.share for each in shares], color=LINE_COLOUR)
    for row, each in enumerate(shares):
        axes.text(100 * each.share + 1, row, format_share(each.share), va="center")
    axes.set_yticks(range(len(shares)), [name_source(each) for each in shares])
    axes.set_ylim(len(shares) - 0.4, -0.6)
    axes.set_xlim(0, 115)
    axes.set_xlabel("%")
    axes.grid(axis="x", color=ORDINARY_COLOUR, alpha=0.4)
