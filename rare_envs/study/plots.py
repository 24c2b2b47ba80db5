"""Pictures: of an evaluation, of its most likely failure and of a risk, drawn into axes that are given; and films."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Tick
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.transforms import Affine2D
from PIL import Image, ImageDraw

from rare_envs.distributions.space import ScenarioSpace
from rare_envs.envs import rendering
from rare_envs.exposure import RateInterval, TotalRate
from rare_envs.files import replace_file
from rare_envs.people import HumanBenchmark
from rare_envs.plugins import EgoGone, clean_text, one_line, reason_of
from rare_envs.study.arguments import BadInput, output_file
from rare_envs.study.episodes import draw_ordinary, list_columns
from rare_envs.study.events import EventRate
from rare_envs.study.replay import Drive, drive_again
from rare_envs.study.report import Report
from rare_envs.study.text import EVENT_NOUNS, format_rate, format_with_interval
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

if TYPE_CHECKING:
    from samplers.sample import Failures


BACKGROUND_DRAWS = 2000
"""Ordinary scenarios drawn behind the failures."""
MOMENTS, LAST_SECONDS = 4, 3.0
"""Bird's-eye views of a failure, spread over the seconds [s] up to its worst moment."""
VIEW_BEHIND, VIEW_FAR_BEHIND, VIEW_AHEAD = 12.0, 45.0, 48.0
"""Extent of a bird's-eye view of the road around the ego [m]; further behind where there is traffic."""
ORDINARY_ROAD = 14.0
"""Width of a road [m] that a view has room for; on wider ones it is higher."""
CURVES = 3.2
"""Height of the curves under the views, over that of a view of an ordinary road."""
NORMAL_QUANTILE, WIDEST_COV = 1.96, 3.0
"""Half-width of the band around estimates on the way, in standard errors; c.o.v. beyond which it is cut."""
HEADROOM = 1.5
"""Upper ends of the curves' axes over their largest values: room for the legend."""
DEFAULTS: Any = {name: value for name, value in matplotlib.rcParamsDefault.items() if "backend" not in name}
STYLE: Any = {**DEFAULTS, "font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
"""Settings of matplotlib for every picture, whatever a matplotlibrc says, which may lie in the folder of somebody else.
Each is a `Figure` of its own, without pyplot: no window, no global state, whatever backend the user has."""
DOTS_PER_INCH = 120
"""Resolution of every picture."""
MOST_LETTERS = 1_000
"""Of one text in a picture."""
LINE_COLOUR, HIT_COLOUR, ORDINARY_COLOUR = "#3b6fb5", "#c0392b", "#b8b8b8"


@contextlib.contextmanager
def saved_figure(path: Path, width: float, height: float) -> Iterator[Figure]:
    """Yield an empty picture of a size [inch], which is saved at the end of the block; a warning if it cannot be drawn.

    Numbers that are written beside it do not wait for it.
    """
    try:
        with drawing():
            figure = Figure(figsize=(width, height), layout="constrained")
            yield figure
            figure.set_dpi(DOTS_PER_INCH)
            show_literally(figure)
            with replace_file(path) as draft:
                FigureCanvasAgg(figure).print_png(draft)  # type: ignore[no-untyped-call]
    except OSError:
        raise
    except Exception as error:  # of fonts, and of whatever a name or an ego brings along
        warnings.warn(f"{path.name} is missing, it cannot be drawn: {one_line(error)}.", stacklevel=3)


@contextlib.contextmanager
def drawing(**more: Any) -> Iterator[None]:
    """Draw in the block by our settings and more of them, without a word on letters that there is no font for."""
    style: Any = {**STYLE, **more}
    with matplotlib.rc_context(style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph |Matplotlib currently does not support")
        yield


def show_literally(artist: Artist) -> None:
    """Let what is written in a figure be shown as it is, clean and not as mathematics, but for the numbers of axes."""
    if isinstance(artist, Text):
        artist.set_text(clean_text(artist.get_text())[:MOST_LETTERS])
        artist.set_parse_math(False)
    for part in artist.get_children():
        if not isinstance(part, Tick):
            show_literally(part)


def save_plot(path: Path, report: Report) -> None:
    """Draw a report and save it."""
    road, estimate, question = report.study.problem.world.scenario.road, report.estimate, report.study.question
    view = max(1.0, road.lanes * road.width / ORDINARY_ROAD)  # height of a bird's-eye view over that of usual roads
    low, high = estimate.interval
    with saved_figure(path, 16, 5.4 * (MOMENTS * view + CURVES) / (MOMENTS + CURVES)) as figure:
        figure.suptitle(
            f"{question.env_id}, ego {question.ego}: P[f ≤ {estimate.gamma:g}] = {estimate.p:.2e}   "
            f"({100 * estimate.confidence:g} % interval {low:.1e} to {high:.1e}, "
            f"{estimate.n_sim:,} simulations{report.average and f'; {report.average}'})",
            fontsize=12,
            fontweight="bold",
        )
        ((left, middle, right),) = figure.subfigures(1, 3, squeeze=False, width_ratios=(1.0, 1.05, 1.25), wspace=0.03)
        draw_convergence(left.subplots(), report.to_dict())
        draw_failures(middle.subplots(), report.study.problem.space, estimate.failures)
        drive = _replay_likeliest_failure(report)
        if isinstance(drive, str):
            _write_message(right.subplots(), drive)
        else:
            draw_drive(list(right.subplots(MOMENTS + 1, height_ratios=[view] * MOMENTS + [CURVES])), drive)


def _replay_likeliest_failure(report: Report) -> Drive | str:
    """Return the likeliest failure driven again, or the reason why it cannot be shown."""
    failures = report.estimate.failures
    driven = np.flatnonzero(~np.isnan(failures.f))  # not those on which the ego failed
    if not len(driven):
        return "no failure found that can be shown" if failures.total else explain_no_failure(report)
    try:
        return drive_again(report.study.problem, failures.x[driven[0]])
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's, and need not do again what it did before
        return f"the failure cannot be shown: {reason_of(error)}"


def explain_no_failure(report: Report) -> str:
    """Return what a run without a failure says."""
    estimate = report.estimate
    return (
        f"None of {estimate.n_sim:,} simulations failed.\n\n"
        f"P[f ≤ {estimate.gamma:g}] is below {estimate.interval[1]:.1e} ({100 * estimate.confidence:g} %):\n"
        f"less than one failure in {1 / estimate.interval[1]:,.0f} scenarios.\n\n"
        "Ten times as many simulations would lower this bound to a tenth;\n"
        "methods that search for failures go further."
    )


def draw_convergence(axes: Axes, result: Mapping[str, Any]) -> None:
    """Draw the estimate against the simulations spent, level by level, and its interval; of a sum the parts."""
    trace, gamma, p = result.get("trace") or [], float(result["gamma"]), float(result["p"])
    low, high = (float(end) for end in result["interval"])
    shares = {part["name"]: part["share"] for part in result.get("parts") or []}
    runs = sorted({(level["run"], level.get("stratum") or "") for level in trace})
    by_levels = any(level["gamma"] != gamma for level in trace)
    seen: list[float] = []
    for run in runs:
        levels = [level for level in trace if (level["run"], level.get("stratum") or "") == run]
        spent = np.cumsum([level["n_sim"] for level in levels])
        values = shares.get(run[1], 1.0) * np.array([level["estimate"] or np.nan for level in levels])
        seen += [value for value in values if value > 0]
        (line,) = axes.plot(spent, values, "o-", color=LINE_COLOUR, alpha=max(0.25, 1 / len(runs)), markersize=4)
        if run[1]:
            line.set(color=f"C{list(shares).index(run[1]) + 1}", label=run[1], alpha=0.8)
        gammas, cov = (np.array([level[name] for level in levels], dtype=float) for name in ("gamma", "cov"))
        if len(runs) == 1 and by_levels:  # each threshold that differs from the one before
            for i in np.flatnonzero(np.isfinite(values) & (np.diff(gammas, prepend=np.nan) != 0)):
                place: Any = {"xytext": (5, 5), "textcoords": "offset points", "fontsize": 8}
                axes.annotate(f"f ≤ {gammas[i]:.3g}", (spent[i], values[i]), **place)
        elif len(runs) == 1:
            cov = np.nan_to_num(cov, nan=np.inf)
            spread = np.exp(NORMAL_QUANTILE * np.minimum(cov, WIDEST_COV))
            axes.fill_between(spent, values / spread, values * spread, color=LINE_COLOUR, alpha=0.15, linewidth=0)
    axes.axhspan(max(low, 1e-300), high, color=HIT_COLOUR, alpha=0.12, linewidth=0)
    if p == 0 and not result.get("n_failures"):
        n_sim = int(result["n_sim"])
        spent = np.geomspace(1.0, max(n_sim, 2), 100)
        bound = np.minimum(high * n_sim / spent, 1.0)
        axes.plot(spent, bound, color=HIT_COLOUR, linewidth=1, label="upper end without a failure: as 1 / simulations")
    if p > 0:
        axes.axhline(p, color=HIT_COLOUR, linewidth=1, label="result")
    label = f"{100 * float(result['confidence']):g} % interval"
    axes.plot([], [], color=HIT_COLOUR, alpha=0.25, linewidth=8, label=label)
    axes.set_yscale("log")
    if by_levels or not seen:
        smallest = min([v for v in (low, p, high / 30) if v > 0], default=1e-9)
        axes.set_ylim(smallest / 3, 1.5)
    else:  # nothing but P[f <= gamma] is estimated on the way
        least, most = min(*seen, max(low, high / 30)), max(*seen, high)
        axes.set_ylim(least / 1.5, min(most * 1.5, 1.5))
    axes.set_xlim(left=0)
    each = "stratum" if shares else f"of {len(runs)} runs"
    axes.set_xlabel("simulations" if len(runs) == 1 else f"simulations, each {each}")
    axes.set_ylabel("P[f ≤ threshold of the level]" if by_levels else f"P[f ≤ {gamma:g}]")
    way = "From ordinary traffic to the failures, level by level" if by_levels else "The estimate, batch by batch"
    axes.set_title(way, fontsize=10)
    axes.legend(loc="upper right", frameon=False)


def draw_failures(axes: Axes, space: ScenarioSpace, failures: Failures) -> None:
    """Draw failures over ordinary traffic in the two parameters in which they differ most."""
    ordinary, columns = draw_ordinary(space)[:BACKGROUND_DRAWS], list_columns(space)
    a, b = 0, 1
    if len(failures):
        shown = np.flatnonzero([column.shown for column in columns])
        spread = np.maximum(ordinary[:, shown].std(axis=0), 1e-12)
        shift = np.abs(failures.x[:, shown].mean(axis=0) - ordinary[:, shown].mean(axis=0)) / spread
        a, b = (int(j) for j in shown[np.argsort(-shift, kind="stable")][:2])
    axes.scatter(ordinary[:, a], ordinary[:, b], s=6, color=ORDINARY_COLOUR, label="ordinary traffic", linewidths=0)
    axes.set(xlabel=columns[a].label, ylabel=columns[b].label)
    if len(failures):
        rising = slice(None, None, -1)  # the most likely on top
        x, y = failures.x[rising, a], failures.x[rising, b]
        dots = axes.scatter(x, y, s=12, c=failures.log_p0[rising], cmap="YlOrRd", linewidths=0)
        assert axes.figure is not None
        axes.figure.colorbar(dots, ax=axes, label="log density in traffic (darker: more likely)")
        axes.plot(x[-1], y[-1], "*", color="black", markersize=13, label="most likely failure")
    title = "Failures against ordinary traffic (two most shifted parameters)"
    axes.set_title(title if len(failures) else "Ordinary traffic; no failure found", fontsize=10)
    axes.legend(loc="best", fontsize=8)


def vehicle_colour(name: str, number: int) -> str:
    """Return the colour of a vehicle by its name, or by its number if scenarios call no vehicle so."""
    return rendering.ROLE_COLOURS.get(name, rendering.OTHER_COLOURS[number % len(rendering.OTHER_COLOURS)])


def choose_moments(drive: Drive) -> list[int]:
    """Return `MOMENTS` moments, spread over the last seconds up to the worst one."""
    first = int(np.argmin(np.abs(drive.time - (drive.time[drive.worst] - LAST_SECONDS))))
    return [int(t) for t in np.linspace(first, drive.worst, MOMENTS).round()]


def draw_drive(axes: list[Axes], drive: Drive) -> None:
    """Draw the seconds up to the worst moment of a drive from above, and its gap and speeds over time."""
    for view, t in zip(axes[:MOMENTS], choose_moments(drive), strict=True):
        draw_moment(view, drive, t)
    axes[0].set_title("The most likely failure from above, and its speeds and gap", fontsize=10)
    draw_speeds(axes[-1], drive)


def draw_moment(axes: Axes, drive: Drive, t: int) -> None:
    """Draw the vehicles at moment t (an index of `drive.time`) from above, the ego at 0 m; bends are straightened."""
    origin = drive.position[t, 0, 0]
    hit, names = drive.collided and t == drive.worst, drive.problem.world.scenario.vehicle_names
    for j, ((x, y), heading) in enumerate(zip(drive.position[t], drive.heading[t], strict=True)):
        body = Rectangle(
            (-VEHICLE_LENGTH / 2, -VEHICLE_WIDTH / 2),
            VEHICLE_LENGTH,
            VEHICLE_WIDTH,
            facecolor=vehicle_colour(names[j], j),
            edgecolor=rendering.CRASH_COLOUR if hit and j == 0 else "none",
        )
        body.set_transform(Affine2D().rotate(heading).translate(x - origin, y) + axes.transData)
        axes.add_patch(body)
    left, *_, right = drive.road.edges
    for y in drive.road.edges:
        colour, dashes = ("black", (None, None)) if y in (left, right) else (ORDINARY_COLOUR, (6, 6))
        axes.axhline(y, color=colour, linewidth=1, dashes=dashes)
    furthest = float(np.max(drive.position[:, :1, 0] - drive.position[..., 0])) + VEHICLE_LENGTH
    axes.set_xlim(-min(max(VIEW_BEHIND, furthest), VIEW_FAR_BEHIND), VIEW_AHEAD)
    # the lateral axis points right of the direction of travel, which is down when driving to the right
    axes.set_ylim(right + 0.1 * drive.road.width, left - 0.1 * drive.road.width)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_ylabel(f"{drive.time[t]:.1f} s", rotation=0, ha="right", va="center")
    if t == drive.worst:
        style: Any = {"color": HIT_COLOUR, "ha": "right", "va": "center", "fontweight": "bold"}
        axes.text(VIEW_AHEAD, drive.position[t, 0, 1], "collision" if hit else "closest", **style)


def draw_speeds(axes: Axes, drive: Drive) -> None:
    """Draw speeds (left axis) and the gap to the vehicle ahead (right axis) over time."""
    for j, (name, role) in enumerate(zip(drive.names, drive.problem.world.scenario.vehicle_names, strict=True)):
        axes.plot(drive.time, drive.speed[:, j], color=vehicle_colour(role, j), label=f"speed of {name}")
    axes.set(xlabel="time [s]", ylabel="speed [m/s]", ylim=(0, HEADROOM * max(1.0, float(drive.speed.max()))))
    gaps = axes.twinx()
    gap = np.where(np.isfinite(drive.gap), drive.gap, np.nan)
    gaps.plot(drive.time, gap, color="black", linestyle=":", label="gap to the vehicle ahead")
    gaps.set_ylabel("gap [m]")
    gaps.set_ylim(min(0.0, float(np.nanmin(gap, initial=0.0))), HEADROOM * float(np.nanmax(gap, initial=1.0)))
    gaps.spines["right"].set_visible(True)
    parts = zip(axes.get_legend_handles_labels(), gaps.get_legend_handles_labels(), strict=True)
    handles, labels = ([*own, *more] for own, more in parts)
    axes.legend(handles, labels, loc="upper center", ncols=2 if len(drive.names) < 5 else 3, fontsize=8, frameon=False)


def _write_message(axes: Axes, text: str) -> None:
    """Write a sentence in place of a drawing."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)


def draw_measure(axes: Axes, drive: Drive) -> None:
    """Draw the measure over time: that of each moment, and that of the drive so far."""
    axes.plot(drive.time, drive.f_alone, color="#777777", linewidth=1, label="this moment")
    axes.step(drive.time, drive.f_so_far, where="post", color="black", linewidth=1.5, label="f so far")
    axes.set_xlabel("time [s]")


FRACTION_BELOW = 0.1
"""Left end of the axis over the smallest number on it, where an interval reaches down to 0."""


def save_risk_plot(
    path: Path, ego: str, total: TotalRate, events: Sequence[EventRate], people: HumanBenchmark | None
) -> None:
    """Draw the rates of events and their sum beside those of people, and save it."""
    level, ends = f"{100 * total.confidence:g} %: ", total.interval_per_million_km
    rows: list[tuple[str, float, RateInterval, HumanBenchmark | None]] = [
        (_name_row(each), each.rate.per_million_km, each.rate.interval_per_million_km, each.people) for each in events
    ]
    rows.append(("all of these", total.per_million_km, ends, people))
    with saved_figure(path, 10, 2.2 + 0.8 * len(rows)) as figure:
        said = format_with_interval(total.per_million_km, ends, " collisions per million km", level)
        figure.suptitle(f"{ego}: {said}", fontsize=14, fontweight="bold")
        draw_rates(figure.subplots(), rows)


def _name_row(each: EventRate) -> str:
    """Return an event in words, and whether its rate is calibrated."""
    name = EVENT_NOUNS.get(each.event, each.event)
    why = each.uncalibrated if each.calibration is not None else "no calibration"  # without a file's long name
    return f"{name}\n({why})" if why else name


def draw_rates(axes: Axes, rows: Sequence[tuple[str, float, RateInterval, HumanBenchmark | None]]) -> None:
    """Draw rates with intervals, and below each that of people."""
    human = [(each.per_million_km, each.interval_per_million_km) for *_, each in rows if each is not None]
    shown = [end for ends in (*(row[2] for row in rows), *(ends for _, ends in human)) for end in ends if end > 0]
    start = FRACTION_BELOW * min(shown)
    for row, (_, rate, ends, people) in enumerate(rows):
        _draw_interval(axes, row - 0.15, rate, ends, HIT_COLOUR if row == len(rows) - 1 else LINE_COLOUR, start)
        if people is not None:
            beside = people.per_million_km, people.interval_per_million_km
            _draw_interval(axes, row + 0.15, *beside, ORDINARY_COLOUR, start)
    axes.plot([], [], "o-", color=LINE_COLOUR, linewidth=4, label="the ego")
    axes.plot([], [], "o-", color=ORDINARY_COLOUR, linewidth=4, label="people in the same events (100-Car)")
    axes.set(xscale="log", xlim=(start, max(shown) / FRACTION_BELOW), ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize=12)
    axes.set_xlabel("collisions per million km", fontsize=12)
    axes.grid(axis="x", color=ORDINARY_COLOUR, alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=2, fontsize=11, frameon=False)


def _draw_interval(axes: Axes, y: float, rate: float, ends: RateInterval, colour: str, start: float) -> None:
    """Draw a rate with its interval; an upper end alone as an arrow out of the axis, without a point."""
    low, high = ends
    if low > 0:
        axes.plot([low, high], [y, y], color=colour, linewidth=4, alpha=0.5, solid_capstyle="butt")
        axes.plot(rate, y, "o", color=colour, markersize=8)
        return
    axes.annotate("", (start, y), (high, y), arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 2})
    axes.plot(high, y, "|", color=colour, markersize=14, markeredgewidth=2)
    axes.annotate(f"below {format_rate(high)}", (high, y), (6, -4), textcoords="offset points", fontsize=11)


CURVES_HEIGHT = 144
"""Height of the curves below the road of a film [pixels]."""
LAST_FRAME_TICKS = 10
"""Ticks for which the last picture stays."""
MARKER: rendering.Colour = (200, 0, 150)
"""Line at the present moment in the curves."""


def draw_frames(drive: Drive) -> list[Image.Image]:
    """Return one picture for each moment, the road above the curves."""
    renderer, shown = rendering.Renderer(drive.problem.world), []
    curves, columns, (top, bottom) = _draw_curves(drive)
    for k, episode in enumerate(drive.episodes):
        road = renderer.draw(episode, drive.time[k])
        below = curves.copy()
        ImageDraw.Draw(below).line([(columns[k], top), (columns[k], bottom)], fill=MARKER, width=2)
        picture = Image.new("RGB", (rendering.FRAME_WIDTH, road.shape[0] + CURVES_HEIGHT))
        picture.paste(Image.fromarray(road), (0, 0))
        picture.paste(below, (0, road.shape[0]))
        shown.append(picture)
    return shown


@matplotlib.rc_context(DEFAULTS)
def _draw_curves(drive: Drive) -> tuple[Image.Image, list[int], tuple[int, int]]:
    """Return the measure over time as a picture; the column of each moment in it, and the ends of the axes [pixels]."""
    measure = drive.problem.world.measurement.measure
    figure = Figure(figsize=(rendering.FRAME_WIDTH / 100, CURVES_HEIGHT / 100), dpi=100)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.08, 0.3, 0.9, 0.62))
    draw_measure(axes, drive)
    axes.set_xlim(0.0, max(drive.problem.world.clock.dt, float(drive.time[-1])))
    axes.set_ylabel(measure if isinstance(measure, str) else "measure")
    axes.xaxis.label.set_fontsize(8)
    axes.yaxis.label.set_fontsize(8)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=7, loc="upper right", frameon=False)
    show_literally(figure)
    canvas.draw()
    columns = axes.transData.transform(np.column_stack((drive.time, np.zeros(len(drive.time)))))[:, 0]
    box = axes.get_window_extent()
    ends = (round(CURVES_HEIGHT - box.y1), round(CURVES_HEIGHT - box.y0))
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()), [round(each) for each in columns], ends


def check_film_path(path: Path | str) -> None:
    """Refuse a name whose pictures cannot be written."""
    path = Path(path)
    if path.suffix.lower() not in (".gif", ".png"):
        raise BadInput(f"Expected a file that ends in .gif (the drive) or .png (its worst moment), got {str(path)!r}.")


def write_film(path: Path | str, drive: Drive, width: int = rendering.FRAME_WIDTH, every: int = 1) -> None:
    """Write a drive as a moving picture (.gif), or its worst moment (.png).

    Args:
        path: The file; its folder is made if there is none.
        drive: What to show.
        width: Of the pictures [pixels].
        every: Show one tick out of so many.

    Raises:
        BadInput: See `check_film_path`, or the folder cannot be made or written to.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from rare_envs import DrivingProblem
        >>> from rare_envs.study import drive_again
        >>> drive = drive_again(DrivingProblem("rare_envs/CarFollowing-v0", horizon=1.0), np.array([20.0, 5.0, 10.0]))
        >>> with TemporaryDirectory() as folder:
        ...     write_film(Path(folder) / "worst.png", drive, width=300)
        ...     with Image.open(Path(folder) / "worst.png") as picture:
        ...         picture.size
        (300, 132)
    """
    check_film_path(path)
    path = Path(path)
    frames = draw_frames(drive)
    size = (width, round(frames[0].height * width / rendering.FRAME_WIDTH))
    shown = [frame.resize(size, Image.Resampling.LANCZOS) for frame in frames]
    with output_file(path), replace_file(path) as draft:
        if path.suffix.lower() == ".png":
            shown[drive.worst].save(draft)
            return
        with draft.open("wb") as file:
            save_gif(file, shown, drive.problem.world.clock.dt, every)


def _make_gif_palette() -> Image.Image:
    """Return a picture with the colours of a GIF: greys, and those of vehicles as they are, in shade and in light."""
    named = (*rendering.ROLE_COLOURS.values(), *rendering.OTHER_COLOURS, rendering.CRASH_COLOUR)
    colours = [*map(rendering.as_rgb, named), MARKER, rendering.AGENT]
    mixed = [
        tuple(round((1 - share) * own + share * other) for own, other in zip(colour, beside, strict=True))
        for colour in colours
        for beside, share in (((100, 100, 100), 0.5), ((255, 255, 255), 0.5), ((0, 0, 0), 0.4))
    ]
    greys = [(level, level, level) for level in range(0, 256, 5)]
    picture = Image.new("P", (1, 1))
    picture.putpalette([value for colour in (*colours, *mixed, *greys) for value in colour])
    return picture


def save_gif(file: IO[bytes], shown: list[Image.Image], dt: float, every: int = 1) -> None:
    """Write pictures, one for each tick of dt [s], as a moving one that shows one out of `every`; the last stays."""
    tick, kept = round(1000 * dt), shown[:-1:every]
    palette = _make_gif_palette()
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in (*kept, shown[-1])]
    durations = [tick * every] * len(kept) + [tick * LAST_FRAME_TICKS]
    more: dict[str, Any] = {"append_images": frames[1:], "duration": durations, "loop": 0, "optimize": True}
    frames[0].save(file, format="GIF", save_all=True, **more)
