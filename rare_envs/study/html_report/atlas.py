"""Failure atlas: each mode with its most likely failure driven again, and the recorded event nearest to it."""

from __future__ import annotations

import base64
import csv
import io
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from rare_envs.envs.rendering import FRAME_WIDTH
from rare_envs.plugins import EgoGone, reason_of
from rare_envs.problem import DrivingProblem
from rare_envs.study.arguments import BadInput
from rare_envs.study.episodes import find_ordinary_range, format_value, list_columns
from rare_envs.study.html_report.figures import FigureOfPage
from rare_envs.study.plots import HIT_COLOUR, MOMENTS, choose_moments, draw_measure, draw_moment, draw_speeds
from rare_envs.study.replay import Drive, drive_again, read_row
from rare_envs.study.text import describe_kind, format_probability, name_measure
from rare_envs.study.video import draw_frames, save_gif
from samplers.problem import FloatArray


class NearestEvent(NamedTuple):
    """The recorded event that is nearest to a failure."""

    distance: float
    """Root mean square over the parameters of their differences in standard deviations of ordinary traffic."""
    rarer: float
    """Share of ordinary scenarios that are at least as far from the event nearest to them."""
    values: FloatArray
    """Its parameters, shape (k,)."""


def read_recorded_events(path: Path, names: list[str]) -> FloatArray:
    """Read events from a CSV file with a column for each of some parameters; others are not looked at.

    Returns:
        Events, shape (n, k); rows with an empty cell are left out.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        missing = [name for name in names if rows and name not in rows[0]]
        if missing or not rows:
            has = f"it has {', '.join(rows[0])}" if rows else "it has no rows"
            raise BadInput(
                f"Expected events in {str(path)!r} with columns named as the parameters, {', '.join(names)}; {has}."
            )
        values = np.array([[float(row[name] or "nan") for name in names] for row in rows])
    except OSError as error:
        raise BadInput(f"Cannot read {str(path)!r}: {error.strerror}.") from error
    except (ValueError, TypeError, csv.Error) as error:
        raise BadInput(f"{str(path)!r} is no table of events: {error}.") from error
    known: FloatArray = values[np.isfinite(values).all(axis=1)]
    if not len(known):
        raise BadInput(f"{str(path)!r} has no event with all of {', '.join(names)}.")
    return known


def find_nearest_event(x: FloatArray, events: FloatArray, ordinary: FloatArray) -> NearestEvent:
    """Return the event nearest to a failure x (k,), among events (n, k), beside ordinary scenarios (m, k)."""
    spread = np.maximum(ordinary.std(axis=0), 1e-12)
    distances = _distances(x[None], events, spread)[0]
    nearest = int(distances.argmin())
    usual = _distances(ordinary, events, spread).min(axis=1)
    return NearestEvent(float(distances[nearest]), float((usual >= distances[nearest]).mean()), events[nearest])


def _distances(x: FloatArray, events: FloatArray, spread: FloatArray) -> FloatArray:
    """Return distances of x (m, k) to events (n, k), shape (m, n)."""
    squares = sum(
        ((x[:, None, j] - events[None, :, j]) / spread[j]) ** 2 for j in range(x.shape[1])
    )  # parameter by parameter, for memory
    return np.asarray(np.sqrt(squares / x.shape[1]))


MOST_MODES = 8
"""Modes that are shown with pictures; the others have a row in the table."""
CLIP_WIDTH, CLIP_EVERY = 560, 2
"""Width of a clip [pixels], and of how many ticks it shows one."""
CLIP_SECONDS = 5.0
"""Seconds of a clip, the last ones up to the end of the drive."""


class AtlasEntry(NamedTuple):
    """A mode of failure as the page shows it."""

    number: int
    title: str
    share: str
    facts: Sequence[tuple[str, str]] = ()
    """Names and values."""
    parameters: Sequence[tuple[str, str, str, str]] = ()
    """Name, value at the failure, where nine of ten ordinary scenarios lie, and value of the nearest event."""
    clip: str = ""
    """Moving picture as a data URI; "" if there is none."""
    figures: Sequence[FigureOfPage] = ()
    missing: str = ""
    """Why there are no pictures; "" if there are."""


class AtlasSource(NamedTuple):
    """What the atlas of a run is made from."""

    folder: Path
    problem: DrivingProblem
    failures: Mapping[str, Any]
    """Of failures.csv."""
    ordinary: FloatArray
    """Draws of the base distribution, shape (n, d)."""
    events: FloatArray | None
    """Recorded events, columns of x that are shown, shape (m, k); None without recordings."""


def build_atlas(source: AtlasSource, modes: list[dict[str, Any]]) -> list[AtlasEntry]:
    """Return the entries of the largest modes."""
    return [_build_entry(source, number, mode) for number, mode in enumerate(modes[:MOST_MODES], 1)]


def _build_entry(source: AtlasSource, number: int, mode: Mapping[str, Any]) -> AtlasEntry:
    crash, failure = str(mode.get("crash", "")), mode.get("failure")
    low, high = mode["interval"]
    share = (
        f"{100 * float(mode['of_failures']):.3g} % of p: {format_probability(mode['p'])} "
        f"({format_probability(low, mode['p'])} to {format_probability(high, mode['p'])})"
    )
    title = f"Mode {number}: {describe_kind(crash)}"
    entry = AtlasEntry(number, title, share)
    if failure is None:
        return entry._replace(missing="none of its failures is in failures.csv")
    x = read_row(source.failures, source.problem, int(failure))
    nearest = None
    if source.events is not None:
        shown = [column.shown for column in list_columns(source.problem.space)]
        nearest = find_nearest_event(x[shown], source.events, source.ordinary[:, shown])
    facts = _list_facts(source, int(failure), nearest)
    entry = entry._replace(facts=facts, parameters=_list_parameters(source, x, nearest))
    try:
        drive = drive_again(source.problem, x)
        figures, clip = _draw_drive(drive, number), encode_clip(drive)
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's, and need not do again what it did before
        return entry._replace(missing=f"it cannot be shown: {reason_of(error)}")
    return entry._replace(facts=_describe_crash(drive) + facts, clip=clip, figures=figures)


def _list_facts(source: AtlasSource, failure: int, nearest: NearestEvent | None) -> list[tuple[str, str]]:
    run = shlex.quote(str(source.folder))
    facts = [("f", f"{float(source.failures['f'][failure]):.4g}")]
    if nearest is not None:
        rarer = f"{100 * nearest.rarer:.2g} % of ordinary scenarios are as far from theirs"
        facts.append(("nearest recorded", f"{nearest.distance:.2g} standard deviations per parameter away; {rarer}"))
    return [*facts, ("replay", f"rare-envs replay {run} --failure {failure} --out failure_{failure}.gif")]


def _describe_crash(drive: Drive) -> list[tuple[str, str]]:
    """Return who ran into whom, how fast, and what it did."""
    crash = drive.crash
    if crash is None:
        return [("end", f"no crash; the worst moment is at {drive.time[drive.worst]:.1f} s")]
    who, whom = ("the edge of the road" if j < 0 else drive.names[j] for j in crash["vehicles"])
    return [
        ("crash", f"{who} into {whom} after {drive.time[-1]:.1f} s, at {crash['impact_speed']:.1f} m/s"),
        ("closing speed", f"{crash['closing_speed']:.1f} m/s of it, at right angles to what touches"),
        ("delta-v", f"{max(crash['delta_v']):.2g} m/s"),
        ("serious injury (MAIS 3+)", f"{100 * max(crash['injury_risk']):.2g} %"),
    ]


def _list_parameters(
    source: AtlasSource, x: FloatArray, nearest: NearestEvent | None
) -> list[tuple[str, str, str, str]]:
    low, high = find_ordinary_range(source.ordinary)
    rows, shown = [], 0
    for j, column in enumerate(list_columns(source.problem.space)):
        if column.shown:
            event = "" if nearest is None else format_value(nearest.values[shown])
            shown += 1
            usual = f"{format_value(low[j])} to {format_value(high[j])}"
            rows.append((column.label, format_value(x[j]), usual, event))
    return rows


def _draw_drive(drive: Drive, number: int) -> list[FigureOfPage]:
    """Return the figures of a drive: from above, the measure, and speeds."""

    def draw_views(figure: Figure) -> None:
        for axes, t in zip(figure.subplots(MOMENTS, 1), choose_moments(drive), strict=True):
            draw_moment(axes, drive, t)

    height = 0.25 + MOMENTS * max(0.6, 0.045 * drive.road.lanes * drive.road.width)
    return [
        FigureOfPage(f"mode{number}-{name}", caption, draw, (6.4, tall))
        for name, caption, draw, tall in (
            ("views", "From above; the ego is green", draw_views, height),
            ("measure", "The measure over time", lambda figure: _draw_measure(figure, drive), 2.2),
            ("speeds", "Speeds and gap over time", lambda figure: draw_speeds(figure.subplots(), drive), 2.8),
        )
    ]


def _draw_measure(figure: Figure, drive: Drive) -> None:
    axes = figure.subplots()
    measure = drive.problem.world.measurement.measure
    draw_measure(axes, drive)
    axes.axvline(drive.time[drive.worst], color=HIT_COLOUR, linewidth=1, label="worst moment")
    axes.set_ylabel(name_measure(measure if isinstance(measure, str) else ""))
    axes.legend(frameon=False, fontsize=8)


def encode_clip(drive: Drive) -> str:
    """Return the last seconds of a drive as a data URI."""
    frames = draw_frames(drive)
    dt = drive.problem.world.clock.dt
    frames = frames[-max(round(CLIP_SECONDS / dt), 2) :]
    size = (CLIP_WIDTH, round(frames[0].height * CLIP_WIDTH / FRAME_WIDTH))
    buffer = io.BytesIO()
    save_gif(buffer, [frame.resize(size, Image.Resampling.LANCZOS) for frame in frames], dt, CLIP_EVERY)
    return f"data:image/gif;base64,{base64.b64encode(buffer.getvalue()).decode()}"
