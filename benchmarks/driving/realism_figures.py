"""Tables and figures of `benchmarks.driving.realism`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

Found = dict[str, Any]
COLOURS = ("#222222", "#b8b8b8", "#7a7a7a", "#3b6fb5", "#2a9d3a", "#e08a1e", "#8e5aa8", "#3aa6a6", "#c0392b")
RATES = {
    "collision": "collision",
    "ever": "ever collides",
    "off_road": "off road",
    "hard_brake": "hard brake",
    "lane_changes": "lane changes / 10 s",
}
QUANTITIES = {
    "speed": "speed [m/s]",
    "acceleration": "acceleration [m/s²]",
    "jerk": "jerk [m/s³]",
    "yaw_rate": "yaw rate [rad/s]",
    "inverse_ttc": "inverse TTC [1/s]",
    "gap": "beam ahead [m]",
}
ERRORS = {"position": "position [m]", "speed": "speed [m/s]", "lateral": "lateral [m]"}
STYLE = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "imitation"}


def format_tables(found: Found) -> str:
    """Return all tables as Markdown."""
    main = [row for row in found["realism"] if row["kind"] != "box"]
    boxed = [row for row in found["realism"] if row["kind"] == "box"]
    parts = ["## All vehicles driven", *(f"{s}:\n\n{_realism(main, s)}" for s in _times(main))]
    parts += ["## One vehicle driven, the others replayed", _error_table(found["replayed"])]
    parts += ["## Six cars at 10 to 20 m/s", _highway(found["highway"])]
    if boxed:
        parts += [f"## Weights moved within a box, {_times(boxed)[0]}", _boxes(boxed)]
    return "\n\n".join(parts) + "\n"


def _times(rows: Sequence[Found]) -> list[str]:
    """Return the names of figures of rows that belong to one time, such as "10 s"."""
    return [name for name in rows[0] if name.endswith(" s")]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))


def _plus(row: Found, name: str) -> str:
    """Return a value with its standard error."""
    value, error = row[name], row["standard_error"][name]
    return f"{value:.4f} ({error:.4f})" if name not in ("lane_changes", "ever") else f"{value:.3f} ({error:.3f})"


def _realism(rows: Sequence[Found], seconds: str) -> str:
    head = ["driver", *RATES.values(), "speed", *(f"JS {name.replace('_', ' ')}" for name in QUANTITIES), "RMSE 5 s"]
    lines = []
    for row in rows:
        one = row[seconds]
        rmse = "/".join(f"{one['rmse'][name]:.2f}" for name in ERRORS) if one["rmse"] else ""
        rates = [_plus(one, name) for name in RATES]
        divergences = [f"{one['divergence'][name]:.3f}" for name in QUANTITIES]
        lines.append([row["name"], *rates, f"{one['mean_speed']:.1f}", *divergences, rmse])
    return _table(head, lines)


def _error_table(errors: dict[str, Found]) -> str:
    times = list(dict.fromkeys(time for one in errors.values() for time in one))
    head = ["driver", *(f"{time} s" for time in times)]
    return _table(
        head,
        [
            [name, *("/".join(f"{one[time][what]:.2f}" for what in ERRORS) if time in one else "" for time in times)]
            for name, one in errors.items()
        ],
    )


def _highway(rows: Sequence[Found]) -> str:
    head = [
        "driver",
        *(f"{name}, {s}" for s in _times(rows) for name in RATES.values()),
        "mean speed at 20 s",
        "slowest",
    ]
    return _table(
        head,
        [
            [
                row["name"],
                *(_plus(row[s], name) for s in _times(rows) for name in RATES),
                f"{row['last_speed']:.1f}",
                f"{row['slowest']:.1f}",
            ]
            for row in rows
        ],
    )


def _boxes(rows: Sequence[Found]) -> str:
    head = ["driver", "radius", "direction", *RATES.values(), "speed", "JS acceleration", "JS yaw rate"]
    seconds = _times(rows)[0]
    return _table(
        head,
        [
            [
                row["driver"],
                f"{row['radius']:g}",
                row["direction"],
                *(_plus(row[seconds], name) for name in RATES),
                f"{row[seconds]['mean_speed']:.1f}",
                *(f"{row[seconds]['divergence'][name]:.3f}" for name in ("acceleration", "yaw_rate")),
            ]
            for row in rows
        ],
    )


def write_figures(found: Found, out: Path) -> None:
    """Write `rates.svg`, `distributions.svg`, `errors.svg` and, if weights have a distribution, `boxes.svg`."""
    with matplotlib.rc_context(STYLE):
        figures = {"rates": _draw_rates(found), "distributions": _distributions(found), "errors": _errors(found)}
        if any(row["kind"] == "box" for row in found["realism"]):
            figures["boxes"] = _box_figure(found)
        for name, figure in figures.items():
            figure.savefig(out / f"{name}.svg", metadata={"Date": None})


def _draw_rates(found: Found) -> Figure:
    """Draw rates of all rows but constant velocity, beside which the others could not be told apart."""
    rows = [row for row in found["realism"] if row["kind"] != "box" and row["name"] != "constant velocity"]
    figure = Figure(figsize=(12, 1.2 + 0.3 * len(rows)), layout="constrained")
    axes = figure.subplots(1, len(RATES), sharey=True)
    place = np.arange(len(rows))
    for axis, (name, title) in zip(axes, RATES.items(), strict=True):
        for shift, (seconds, colour) in zip(
            (-0.12, 0.12), zip(_times(rows), ("#3b6fb5", "#e08a1e"), strict=True), strict=True
        ):
            values = [row[seconds][name] for row in rows]
            errors = [row[seconds]["standard_error"][name] for row in rows]
            axis.errorbar(values, place + shift, xerr=errors, fmt="o", ms=4, color=colour, label=seconds)
        axis.set_title(title)
        axis.set_xlim(left=0.0)
    axes[0].set_yticks(place, [row["name"] for row in rows])
    axes[0].invert_yaxis()
    axes[-1].legend(frameon=False)
    return figure


def _distributions(found: Found) -> Figure:
    rows = [row for row in found["realism"] if row["kind"] in ("reference", "driver")]
    figure = Figure(figsize=(12, 6), layout="constrained")
    for axis, (name, title) in zip(figure.subplots(2, 3).flat, QUANTITIES.items(), strict=True):
        low, high, bins = found["bins"][name]
        edges = np.linspace(low, high, bins + 1)
        for row, colour in zip(rows, COLOURS, strict=False):
            style = {"fill": True, "alpha": 0.3} if row["name"] == "people" else {}
            axis.stairs(row["shares"][name], edges, color=colour, label=row["name"], **style)
        axis.set_title(title)
        axis.set_yscale("log" if name in ("acceleration", "jerk", "yaw_rate", "inverse_ttc") else "linear")
        if axis.get_yscale() == "log":
            axis.set_ylim(bottom=1e-5)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    return figure


def _errors(found: Found) -> Figure:
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    for axis, (what, title) in zip(figure.subplots(1, 3), ERRORS.items(), strict=True):
        for (name, one), colour in zip(found["replayed"].items(), COLOURS[1:], strict=False):
            times = [float(time) for time in one]
            values = [one[time][what] for time in one]
            errors = [one[time][f"{what}_standard_error"] for time in one]
            axis.errorbar(times, values, yerr=errors, color=colour, label=name, marker="o", ms=3)
        axis.set_title(f"RMSE, {title}")
        axis.set_xlabel("time [s]")
        axis.set_ylim(bottom=0.0)
    axis.legend(frameon=False)
    return figure


def _box_figure(found: Found) -> Figure:
    """Draw rates of the first driver with a distribution of weights over the radius, for each direction."""
    rows = [row for row in found["realism"] if row["kind"] == "box"]
    rows = [row for row in rows if row["driver"] == rows[0]["driver"]]
    base = next(row for row in found["realism"] if row["name"] == rows[0]["driver"])
    seconds = _times(rows)[0]
    figure = Figure(figsize=(12, 3.8), layout="constrained")
    shown = {
        "collision": "collision",
        "off_road": "off road",
        "lane_changes": "lane changes / 10 s",
        "mean_speed": "speed [m/s]",
    }
    directions = list(dict.fromkeys(row["direction"] for row in rows))
    colours = [matplotlib.colormaps["tab10"](k) for k in range(len(directions))]
    for axis, (name, title) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
        axis.axhline(base[seconds][name], color="#222222", lw=1, ls=":")
        for direction, colour in zip(directions, colours, strict=True):
            mine = [row for row in rows if row["direction"] == direction]
            axis.plot(
                [row["radius"] for row in mine],
                [row[seconds][name] for row in mine],
                "o-",
                ms=3,
                color=colour,
                label=direction,
            )
        axis.set_xscale("log")
        axis.set_xlabel("half-width of the box")
        axis.set_title(title)
    figure.suptitle(f"{rows[0]['driver']}: weights moved within a box (dotted: not moved)")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    return figure
