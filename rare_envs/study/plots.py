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
from matplotlib.patches import Patch, Rectangle
from matplotlib.rcsetup import cycler
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Affine2D
from PIL import Image, ImageDraw

from rare_envs.distributions.space import ScenarioSpace
from rare_envs.envs import rendering
from rare_envs.exposure import CollisionRate, RateInterval, TotalRate
from rare_envs.files import replace_file
from rare_envs.measures import MEASURES
from rare_envs.people import EventRate, HumanBenchmark
from rare_envs.plugins import EgoGone, clean_text, one_line, reason_of
from rare_envs.study import run_folder
from rare_envs.study.arguments import BadInput, output_file
from rare_envs.study.episodes import draw_ordinary, list_columns
from rare_envs.study.replay import Drive, describe_contact, drive_again
from rare_envs.study.report import Report
from rare_envs.study.text import EVENT_NOUNS, format_with_interval, name_measure
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH
from samplers.problem import FloatArray

if TYPE_CHECKING:
    from samplers.sample import Failures


BACKGROUND_DRAWS = 2000
"""Ordinary scenarios drawn behind the failures."""
MOMENTS, LAST_SECONDS = 4, 3.0
"""Bird's-eye views of a failure, spread over the seconds [s] up to its worst moment."""
VIEW_BEHIND, VIEW_FAR_BEHIND, VIEW_AHEAD = 12.0, 45.0, 48.0
"""Extent of a bird's-eye view of the road around the ego [m]; further behind if there is traffic."""
HEADROOM = 1.5
"""Upper limits of the curves' axes over their largest values: room for the legend."""
LINE_COLOUR, HIT_COLOUR, ORDINARY_COLOUR = rendering.ROLE_COLOURS["ego"], "#c0392b", "#b8b8b8"
"""What is of the ego, in curves as on the road; failures; and ordinary traffic or people."""
MODEL_COLOUR = "#8e5aa8"
"""The human driver model."""
MILLION = 1_000_000
DECADES = 1e3
"""Ratio of the ends of the axis of an answer at least."""
DEFAULTS: Any = {name: value for name, value in matplotlib.rcParamsDefault.items() if "backend" not in name}
STYLE: Any = {
    **DEFAULTS,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": cycler(color=[LINE_COLOUR, "#7a7a7a", MODEL_COLOUR]),
}
"""Settings of matplotlib for every picture, whatever a matplotlibrc says, which may lie in the folder of somebody else.
Each is a `Figure` of its own, without pyplot: no window, no global state, whatever backend the user has."""
DOTS_PER_INCH, WIDTH = 120, 6.0
"""Resolution of every picture, and its width [inch]: text can be read where 700 pixels are shown."""
MOST_LETTERS = 1_000
"""Of one text in a picture."""


@contextlib.contextmanager
def saved_figure(path: Path, height: float, width: float = WIDTH) -> Iterator[Figure]:
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


def save_pictures(folder: Path, report: Report) -> None:
    """Draw the answer of a run, its most likely crash, and the failures among ordinary traffic: a file for each."""
    failures, space = report.estimate.failures, report.study.problem.space
    with saved_figure(folder / run_folder.ANSWER, 2.2) as figure:
        draw_answer(figure.subplots(), report)
    driven = np.flatnonzero(~np.isnan(failures.f))  # not those on which the ego failed
    if len(driven):
        with saved_figure(folder / run_folder.SCATTER, 4.4) as figure:
            draw_failures(figure.subplots(), space, failures)
        road = report.study.problem.world.scenario.road
        height = 1.0 + MOMENTS * max(0.7, 0.055 * road.lanes * road.width)
        with saved_figure(folder / run_folder.CRASH_STRIP, height) as figure:
            _draw_likeliest(figure, report, failures.x[driven[0]])


def _draw_likeliest(figure: Figure, report: Report, x: FloatArray) -> None:
    """Draw the likeliest failure (d,) driven again, or write the reason why it cannot be shown."""
    try:
        drive = drive_again(report.study.problem, x)
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's, and need not do again what it did before
        axes = figure.subplots()
        axes.set_axis_off()
        message = f"the failure cannot be shown: {reason_of(error)}"
        axes.text(0.5, 0.5, message, ha="center", va="center", wrap=True, transform=axes.transAxes)
        return
    how = "no crash" if drive.crash is None else describe_contact(drive.crash, drive.names)
    figure.suptitle(f"The most likely failure: {how}", fontweight="bold")
    draw_moments(figure, drive)
    roles = drive.problem.world.scenario.vehicle_names
    shown = [Patch(color=vehicle_colour(roles[j], j), label=name) for j, name in enumerate(drive.names)]
    figure.legend(handles=shown, loc="outside lower center", ncols=4, frameon=False)


def one_in(p: float) -> str:
    """Return a probability in words, with two digits.

    Example:
        >>> one_in(2.97e-4), one_in(1e-8), one_in(0.452)
        ('1 in 3,400', '1 in 100 million', '45 in 100')
    """
    if p > 0.1:
        return f"{100 * p:.0f} in 100"
    n = float(f"{1 / p:.2g}")
    return f"1 in {n:,.0f}" if n < MILLION else f"1 in {n / MILLION:,.10g} million"


def draw_answer(axes: Axes, report: Report) -> None:
    """Draw p with all that its interval can hold, that of the simulations within it; a bound alone as an arrow."""
    estimate, question = report.estimate, report.study.question
    base, (low, high), level = estimate.base_uncertainty, estimate.interval, f"{100 * estimate.confidence:g} %"
    widest, behind = (low, high), "simulation"
    if base is not None and estimate.p > 0 and (base.interval or base.bound is not None):
        ends = base.interval or (0.0, base.bound or 1.0)
        widest, behind = (min(low, ends[0]), max(high, ends[1])), f"from {base.fitted_to}"
    start = min(end for end in (*widest, low, high, estimate.p) if end > 0) / (3 if widest[0] > 0 else 30)
    top = min(3 * max(widest[1], high), 1.0)
    start = min(start, top / DECADES)
    _draw_interval(axes, 0.0, estimate.p, widest, LINE_COLOUR, start)
    axes.plot([], [], color=LINE_COLOUR, linewidth=9, alpha=0.35, label=f"{level}, {behind}")
    if behind != "simulation":
        bar: Any = {"color": LINE_COLOUR, "linewidth": 9, "label": "simulation alone"}
        axes.plot([max(low, start), high], [0, 0], solid_capstyle="butt", **bar)
        axes.plot(estimate.p, 0, "o", color="black", markersize=6)
    axes.set(xscale="log", xlim=(start, top), ylim=(-1, 1), yticks=[])
    axes.spines["left"].set_visible(False)
    axes.xaxis.set_major_locator(LogLocator(numticks=5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda p, _: one_in(p)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(f"{question.ego} in {question.env_id}")
    collides = question.measure in ("ttc", "lidar_ttc") and estimate.gamma == 0
    event = "Collision" if collides else f"f ≤ {estimate.gamma:g}"
    if estimate.p > 0:
        most, least = one_in(widest[1]), one_in(widest[0]) if widest[0] > 0 else ""
        said = f"{event}: {one_in(estimate.p)} scenarios\n{level}: "
        said += f"{least} to {most}" if least else f"at most {most}"
    else:
        said = f"{event}: fewer than {one_in(high)} scenarios ({level})\n"
        said += f"no failure counts in {estimate.n_sim:,} simulations"
    axes.set_title(said, fontweight="bold")
    axes.figure.legend(loc="outside lower center", ncols=2, frameon=False)


def draw_failures(axes: Axes, space: ScenarioSpace, failures: Failures) -> None:
    """Draw failures over ordinary traffic in the two parameters in which they differ most, and say how they do."""
    ordinary, columns = draw_ordinary(space)[:BACKGROUND_DRAWS], list_columns(space)
    shown = np.flatnonzero([column.shown for column in columns])
    spread = np.maximum(ordinary[:, shown].std(axis=0), 1e-12)
    shift = (np.median(failures.x[:, shown], axis=0) - np.median(ordinary[:, shown], axis=0)) / spread
    places = np.argsort(-np.abs(shift), kind="stable")[:2]
    a, b = (int(j) for j in shown[[places[0], places[-1]]])
    axes.scatter(ordinary[:, a], ordinary[:, b], s=8, color=ORDINARY_COLOUR, label="ordinary traffic", linewidths=0)
    axes.scatter(failures.x[:, a], failures.x[:, b], s=10, color=HIT_COLOUR, label="failures", linewidths=0)
    axes.plot(failures.x[0, a], failures.x[0, b], "*", color="black", markersize=13, label="most likely failure")
    axes.set(xlabel=columns[a].label.replace("_", " "), ylabel=columns[b].label.replace("_", " "))
    words = [
        f"{'high' if shift[place] > 0 else 'low'} {columns[shown[place]].name.replace('_', ' ')}"
        for place in places
        if abs(shift[place]) > SHIFTED
    ]
    axes.set_title(f"Failures: {', '.join(words) or 'much as ordinary traffic'}", fontweight="bold")
    axes.figure.legend(loc="outside lower center", ncols=3, frameon=False)


def list_severity(severity: Mapping[str, Any] | None) -> list[tuple[float, ...]]:
    """Return three delta-v [km/h] from the curve of a run, each with P[collision with a larger one] and its ends."""
    if severity is None:
        return []
    columns = (severity["curve"][name] for name in ("delta_v", "p", "low", "high"))
    rows = [(3.6 * v, *rest) for v, *rest in zip(*columns, strict=True) if rest[0] > 0]
    return rows[:: max(1, (len(rows) - 1) // 2)][:3]


def vehicle_colour(name: str, number: int) -> str:
    """Return the colour of a vehicle by its name, or by its number if scenarios call no vehicle so."""
    return rendering.ROLE_COLOURS.get(name, rendering.OTHER_COLOURS[number % len(rendering.OTHER_COLOURS)])


def draw_moments(figure: Figure, drive: Drive) -> None:
    """Draw `MOMENTS` moments of a drive, spread over the last seconds up to the worst one."""
    first = int(np.argmin(np.abs(drive.time - (drive.time[drive.worst] - LAST_SECONDS))))
    moments = np.linspace(first, drive.worst, MOMENTS).round().astype(int).tolist()
    for axes, t in zip(figure.subplots(MOMENTS, 1), moments, strict=True):
        draw_moment(axes, drive, t)


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
    before = drive.time[drive.worst] - drive.time[t]
    at: Any = {"color": HIT_COLOUR, "fontweight": "bold"} if t == drive.worst else {}
    words = ("crash" if hit else "closest") if t == drive.worst else f"{before:.1f} s\nbefore"
    axes.set_ylabel(words, rotation=0, ha="right", va="center", **at)


def draw_speeds(axes: Axes, drive: Drive) -> None:
    """Draw the vehicles' speeds over time."""
    for j, (name, role) in enumerate(zip(drive.names, drive.problem.world.scenario.vehicle_names, strict=True)):
        axes.plot(drive.time, drive.speed[:, j], color=vehicle_colour(role, j), label=name)
    axes.set(xlabel="time [s]", ylabel="speed [m/s]", ylim=(0, HEADROOM * max(1.0, float(drive.speed.max()))))
    axes.legend(loc="upper center", ncols=3, frameon=False)


SHOWN_SECONDS = 5.0
"""Upper limit of the axis of a measure in seconds: what is above shows as a gap, the cap of a time to collision too."""


def draw_measure(axes: Axes, drive: Drive) -> None:
    """Draw the measure over time: that of each moment, the least so far, and where the crash or the worst moment is."""
    measure = drive.problem.world.measurement.measure
    name = measure if isinstance(measure, str) else ""
    seconds = getattr(MEASURES.get(name), "unit", "") == "s"
    top = SHOWN_SECONDS if seconds else np.inf
    alive = drive.time < (drive.time[-1] if drive.collided else np.inf)  # not the value that stands for a collision
    for values, words, colour, steps in (
        (drive.f_alone, "this moment", "#777777", "default"),
        (drive.f_so_far, "closest so far", "black", "steps-post"),
    ):
        shown = np.where(alive & (values <= top), values, np.nan)
        axes.plot(drive.time, shown, color=colour, linewidth=1.5, drawstyle=steps, label=words)
    axes.axvline(drive.time[drive.worst], color=HIT_COLOUR, label="crash" if drive.collided else "closest")
    last = max(drive.problem.world.clock.dt, float(drive.time[-1]))
    axes.set(xlabel="time [s]", ylabel=SAID.get(name, name_measure(name)), xlim=(0.0, last))
    if not np.isfinite(drive.f_alone[alive]).any() or float(np.min(drive.f_alone[alive], initial=np.inf)) > top:
        axes.text(0.5, 0.5, f"more than {top:g} s up to the crash", ha="center", va="center", transform=axes.transAxes)
    if seconds:
        axes.set_ylim(float(np.nanmin(drive.f_alone[alive], initial=0.0)), top)


SAID = {"ttc": "time to\ncollision [s]", "lidar_ttc": "time to\ncollision [s]", "clearance": "distance [m]"}
"""Measures in words, for an axis."""
SEVERE = 1.0
"""Delta-v [m/s] beyond which collisions have a picture of their severity; below it a table says all."""
SHIFTED = 0.5
"""Shift of the median of failures over ordinary traffic, in its standard deviations, that is called low or high."""
FRACTION_BELOW = 0.1
"""Left end of the axis over the smallest number on it, where an interval reaches down to 0."""


RateRow = tuple[str, CollisionRate | TotalRate, HumanBenchmark | None, float]
"""Name of a kind of event, collisions per million km in it, people's, and those of the human driver model."""


def _make_row(each: EventRate) -> RateRow:
    """Return the row of an event, with whether its rate is calibrated."""
    name, known = EVENT_NOUNS.get(each.event, each.event), each.calibration
    name = f"{name}\n({'no calibration' if known is None else 'not calibrated'})" if each.uncalibrated else name
    return name, each.rate, each.people, 0.0 if known is None else known.per_million_km().p


def save_risk_plot(
    path: Path, ego: str, total: TotalRate, events: Sequence[EventRate], people: HumanBenchmark | None
) -> None:
    """Draw the rates of events and their sum beside those of people, and save it."""
    level, ends = f"{100 * total.confidence:g} %: ", total.interval_per_million_km
    rows = [*map(_make_row, events), ("all of these", total, people, 0.0)]
    with saved_figure(path, 1.8 + 0.75 * len(rows), 7.0) as figure:
        said = format_with_interval(total.per_million_km, ends, " collisions per million km", level)
        figure.suptitle(f"{ego}\n{said}", fontweight="bold")
        draw_rates(figure.subplots(), rows)


def draw_rates(axes: Axes, rows: Sequence[RateRow]) -> None:
    """Draw rates with intervals, below each that of people, and the human driver model as far as it was measured."""
    known = [each for _, rate, people, _ in rows for each in (rate, people) if each is not None]
    ends = [end for each in known for end in each.interval_per_million_km if end > 0]
    start = FRACTION_BELOW * min(ends)
    for place, (_, rate, people, model) in enumerate(rows):
        for each, below, colour in ((rate, -0.15, LINE_COLOUR), (people, 0.15, ORDINARY_COLOUR)):
            if each is not None:
                beside = each.per_million_km, each.interval_per_million_km
                _draw_interval(axes, place + below, *beside, colour, start)
        if model > start:
            axes.plot(model, place + 0.15, "D", color=MODEL_COLOUR, markersize=6)
    for marker, colour, words in (
        ("o-", LINE_COLOUR, "the ego"),
        ("o-", ORDINARY_COLOUR, "people in the same event"),
        ("D", MODEL_COLOUR, "model of a human driver"),
    ):
        axes.plot([], [], marker, color=colour, linewidth=4, label=words)
    axes.set(xscale="log", xlim=(start, max(ends) / FRACTION_BELOW), ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(range(len(rows)), [name for name, *_ in rows])
    axes.xaxis.set_major_locator(LogLocator(numticks=7))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda rate, _: f"{rate:,.10g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("collisions per million km")
    axes.grid(axis="x", color=ORDINARY_COLOUR, alpha=0.3)
    axes.figure.legend(loc="outside lower center", ncols=3, frameon=False)


def _draw_interval(axes: Axes, y: float, value: float, ends: RateInterval, colour: str, start: float) -> None:
    """Draw a value with its interval; an upper limit alone as an arrow out of the axis."""
    low, high = ends
    if low > 0:
        axes.plot([low, high], [y, y], color=colour, linewidth=9, alpha=0.35, solid_capstyle="butt")
        axes.plot(value, y, "o", color=colour, markersize=8)
    else:
        axes.annotate("", (start, y), (high, y), arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 2})
        axes.plot(high, y, "|", color=colour, markersize=14, markeredgewidth=2)


CURVES_HEIGHT = 144
"""Height of the curves below the road of a film [pixels]."""
SLOWED, LAST_FRAME = 2, 1.0
"""Times as long as the drive that a film of it takes, and seconds for which its last picture stays."""
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
    figure = Figure(figsize=(rendering.FRAME_WIDTH / 100, CURVES_HEIGHT / 100), dpi=100)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.08, 0.3, 0.9, 0.62))
    draw_measure(axes, drive)
    axes.set_xlabel("time [s], shown at half speed")
    axes.legend(loc="upper right", ncols=3, frameon=False)
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
    """Write pictures, one for each tick of dt [s], as a film at half speed of one out of `every`; the last stays."""
    tick, kept = round(1000 * dt * SLOWED), shown[:-1:every]
    palette = _make_gif_palette()
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in (*kept, shown[-1])]
    durations = [tick * every] * len(kept) + [round(1000 * LAST_FRAME)]
    more: dict[str, Any] = {"append_images": frames[1:], "duration": durations, "loop": 0, "optimize": True}
    frames[0].save(file, format="GIF", save_all=True, **more)
