"""Film of a recorded failure: the road, and the safety measure over time below it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from rare_envs.envs.rendering import AGENT, FRAME_WIDTH, Colour, Renderer
from rare_envs.files import replace_file
from rare_envs.problem import DrivingProblem
from rare_envs.study.columns import MAX_SHOWN, format_value
from rare_envs.study.errors import BadInput, as_bad_input, output_file
from rare_envs.study.question import prepare
from rare_envs.study.recorded_question import load_finished, open_run, warn_of_changed_files
from rare_envs.study.replay import Drive
from rare_envs.study.run_folder import FAILURES
from rare_envs.traffic.palette import CRASH_COLOUR, OTHER_COLOURS, ROLE_COLOURS, as_rgb

CURVES_HEIGHT = 144
"""Height of the curves below the road [pixels]."""
REPLAY_TOLERANCE = 1e-3
"""Largest difference of f to the recorded one: products of networks round differently by batch size."""
LAST_FRAME_TICKS = 10
"""Ticks for which the last picture stays."""
MARKER: Colour = (200, 0, 150)
"""Line at the present moment in the curves."""


OWN_NOISE = "ego_noise"
"""Parameter that an ego has which is random itself."""


class RecordedFailure(NamedTuple):
    """A failure as a run has recorded it."""

    problem: DrivingProblem
    x: NDArray[np.float64]
    """Scenario parameters, shape (d,)."""
    f: float
    log_p0: float
    n_listed: int
    """Number of failures that the run lists, the most likely ones."""
    n_found: int
    """Number of failures that it found."""


def find_failure(folder: Path, number: int, trust: bool = False, ego: str | None = None) -> RecordedFailure:
    """Return failure `number` of a run, the most likely being number 0; with another ego in its world, if one is named.

    What code the run or the egos name runs only with `trust`, unless the run was made here.

    Raises:
        BadInput: There is no such run or failure, or what it was about cannot be loaded any longer.
    """
    run = load_finished(folder)
    question, table, count = open_run(run, trust), run.failures, len(run.failures["f"])
    warn_of_changed_files(question, folder)
    if not count:
        raise BadInput("The run has no failure.")
    if not 0 <= number < count:
        raise BadInput(f"Expected a failure from 0 to {count - 1}, got {number}.")
    if ego is not None:
        question = replace(question, ego=ego, algo=None, stats=None, observation=None, action=None)
    with as_bad_input(TypeError, OverflowError, RecursionError, MemoryError):
        problem = prepare(question).problem
    x, found = join_parameters(table, problem, number), run.result.get("n_failures")
    n_found = found if isinstance(found, int) and found > count else count
    return RecordedFailure(problem, x, float(table["f"][number]), float(table["log_p0"][number]), count, n_found)


def join_parameters(table: dict[str, NDArray[Any]], problem: DrivingProblem, number: int) -> NDArray[np.float64]:
    """Return x (d,) of a row; an ego that is random, where the run's was not, has zeros for its noise.

    Raises:
        BadInput: The columns are others than those of the problem, or x is no scenario of its traffic.
    """
    space, parts = problem.space, []
    for name, size in zip(space.names, space.sizes, strict=True):
        part = np.atleast_1d(table[name][number]) if name in table else np.empty(0)
        if not len(part) and name != OWN_NOISE:
            names = ", ".join(space.names)
            raise BadInput(f"Expected {FAILURES} with the columns {names}; the run is of another problem.")
        parts.append(np.zeros(size) if name == OWN_NOISE and len(part) != size else part)
    x = np.concatenate(parts)
    if x.shape != (problem.dim,) or not np.isfinite(x).all() or not np.isfinite(problem.base.log_prob(x[None])).all():
        raise BadInput(f"Failure {number} in {FAILURES} is no scenario of {problem.env_id} and its base distribution.")
    return x


def draw_frames(drive: Drive) -> list[Image.Image]:
    """Return one picture for each moment, the road above the curves."""
    renderer = Renderer(drive.problem.world)
    curves, place = _draw_curves_strip(drive)
    shown = []
    for k, episode in enumerate(drive.episodes):
        road = renderer.draw(episode, drive.time[k])
        picture = Image.new("RGB", (FRAME_WIDTH, road.shape[0] + CURVES_HEIGHT))
        picture.paste(Image.fromarray(road), (0, 0))
        picture.paste(curves, (0, road.shape[0]))
        column, top, bottom = place(drive.time[k])
        ImageDraw.Draw(picture).line(
            [(column, road.shape[0] + top), (column, road.shape[0] + bottom)], fill=MARKER, width=2
        )
        shown.append(picture)
    return shown


def _draw_curves_strip(drive: Drive) -> tuple[Image.Image, Any]:
    """Return the measure over time as a picture, and a function from time to column, top and bottom [pixels] in it."""
    world = drive.problem.world
    time = np.arange(len(drive.f_so_far)) * world.clock.dt
    name = world.measurement.measure if isinstance(world.measurement.measure, str) else "measure"
    figure = Figure(figsize=(FRAME_WIDTH / 100, CURVES_HEIGHT / 100), dpi=100)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.08, 0.3, 0.9, 0.62))
    axes.plot(time, drive.f_alone, color="#777777", linewidth=1, label="this moment")
    axes.step(time, drive.f_so_far, where="post", color="black", linewidth=1.5, label="f so far")
    axes.set_xlim(0.0, max(world.clock.dt, float(time[-1])))
    axes.set_xlabel("time [s]", fontsize=8)
    axes.set_ylabel(name, fontsize=8)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=7, loc="upper right", frameon=False)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())

    def place(at: float) -> tuple[int, int, int]:
        column, _ = axes.transData.transform((at, 0.0))
        box = axes.get_window_extent()
        return round(column), round(CURVES_HEIGHT - box.y1), round(CURVES_HEIGHT - box.y0)

    return picture, place


def describe_drive(recorded: RecordedFailure, drive: Drive, number: int, ego: str | None = None) -> list[str]:
    """Return the drive in words, line by line."""
    space, labels = recorded.problem.space, recorded.problem.world.scenario.labels
    listed = f" ({recorded.n_listed:,} of them listed)" if recorded.n_listed < recorded.n_found else ""
    lines = [
        f"Failure {number} of {recorded.n_found:,} found{listed} in {recorded.problem.env_id}: "
        f"f = {drive.f:.4g}, log p0 = {recorded.log_p0:.2f}"
    ]
    for name, values in space.named(recorded.x).items():
        unit = space.units[space.names.index(name)]
        several = np.atleast_1d(values)
        shown = " ".join(map(format_value, several)) if len(several) <= MAX_SHOWN else f"{len(several)} values"
        lines.append(f"  {name:<15} {shown} {unit}".rstrip())
    end = drive.time[-1]
    crash = drive.crash
    if crash is None:
        lines.append(f"No crash within {end:.1f} s; the worst moment was at {drive.time[drive.worst]:.1f} s.")
    else:
        who, whom = ("the edge of the road" if j < 0 else labels[j] for j in crash["vehicles"])
        how = f"{crash['kind']}, closing at {crash['closing_speed']:.1f} m/s"
        lines.append(f"Crash after {end:.1f} s: {who} into {whom} ({how}).")
    if ego is not None:
        lines.append(f"The ego was {ego}; that of the run had f = {recorded.f:.4g}.")
    elif abs(drive.f - recorded.f) > REPLAY_TOLERANCE:
        why = "ego, drivers or this program have changed since"
        if recorded.problem.varies:
            why = "the ego answers differently from run to run, and what was recorded is what counts"
        lines.append(f"warning: the run recorded f = {recorded.f:.4g}; {why}.")
    return lines


def check_film_path(path: Path | str) -> None:
    """Refuse a name whose pictures cannot be written."""
    path = Path(path)
    if path.suffix.lower() not in (".gif", ".png"):
        raise BadInput(f"Expected a file that ends in .gif (the drive) or .png (its worst moment), got {str(path)!r}.")


def write_film(path: Path | str, drive: Drive, width: int = FRAME_WIDTH, every: int = 1) -> None:
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
    shown = draw_frames(drive)
    shown = [each.resize((width, round(each.height * width / FRAME_WIDTH)), Image.Resampling.LANCZOS) for each in shown]
    with output_file(path), replace_file(path) as draft:
        if path.suffix.lower() == ".png":
            shown[drive.worst].save(draft)
            return
        with draft.open("wb") as file:
            save_gif(file, shown, drive.problem.world.clock.dt, every)


def _make_gif_palette() -> Image.Image:
    """Return a picture with the colours of a GIF: greys, and those of vehicles as they are, in shade and in light.

    A palette found from a picture has mostly greys of the road, and gives two vehicles one colour.
    """
    colours = [*(as_rgb(each) for each in (*ROLE_COLOURS.values(), *OTHER_COLOURS, CRASH_COLOUR)), MARKER, AGENT]
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
    """Write pictures as a moving one.

    Args:
        file: To write to.
        shown: A picture for each tick; the last one stays for a while.
        dt: Length of a tick [s].
        every: Show one tick out of so many.
    """
    tick, kept = round(1000 * dt), shown[:-1:every]
    palette = _make_gif_palette()
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in (*kept, shown[-1])]
    durations = [tick * every] * len(kept) + [tick * LAST_FRAME_TICKS]
    more: dict[str, Any] = {"append_images": frames[1:], "duration": durations, "loop": 0, "optimize": True}
    frames[0].save(file, format="GIF", save_all=True, **more)
