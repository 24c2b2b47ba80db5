"""A failure that a run has found, driven again and shown: the road, and the measure over time below it."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from rare_envs import DrivingProblem
from rare_envs.envs.rendering import WIDTH, Renderer
from rare_envs.measures import Moment
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.rollout import drive
from rare_envs.study.columns import SHOWN, digits
from rare_envs.study.errors import BadInput
from rare_envs.study.evaluate import Question, prepare
from rare_envs.study.run_directory import FAILURES, RESULT, read_failures
from rare_envs.traffic.crash import describe_crash

STRIP = 144
"""Height of the curves below the road [pixels]."""
SAME = 1e-3
"""Largest difference of f to the recorded one: products of networks round differently by batch size."""
LAST = 10
"""The last picture stays for so many ticks."""
COLOURS = 64
"""Of a picture in a GIF."""


class Found(NamedTuple):
    """A failure as a run has recorded it."""

    problem: DrivingProblem
    x: NDArray[np.float64]
    """Scenario parameters, shape (d,)."""
    f: float
    log_p0: float
    of: int
    """How many failures the run has."""


class Drive(NamedTuple):
    """T + 1 moments of one scenario, up to the collision or the horizon."""

    problem: DrivingProblem
    episodes: list[Episode]
    so_far: NDArray[np.float64]
    """f of the episode up to each moment, shape (T + 1,)."""
    alone: NDArray[np.float64]
    """f of each moment as if it were all of the episode, shape (T + 1,)."""

    @property
    def f(self) -> float:
        """The measure of the whole."""
        return float(self.so_far[-1])

    @property
    def crash(self) -> dict[str, Any] | None:
        """What kind of crash it ended in."""
        statistics = self.episodes[-1].statistics
        return None if statistics is None else describe_crash(statistics.crash)

    def time(self, k: int) -> float:
        """Time of moment k [s]."""
        return k * self.problem.world.clock.dt


def find(folder: Path, number: int, trust: bool = False) -> Found:
    """Failure `number` of a run, the most likely being number 0.

    Args:
        folder: Of `rare-envs estimate --out`.
        number: Which failure.
        trust: Let the ego's file run code, as the run was allowed to.

    Raises:
        BadInput: There is no such run or failure, or what it was about cannot be loaded any longer.
    """
    try:
        asked = json.loads((folder / RESULT).read_text(encoding="utf-8"))["question"]
        table = read_failures(folder)
    except (OSError, ValueError, KeyError) as error:
        raise BadInput(
            f"No run in {str(folder)!r}: expected {RESULT} and {FAILURES}, as rare-envs estimate --out writes."
        ) from error
    known = {field.name for field in fields(Question)}
    problem = prepare(Question(**{**{name: asked[name] for name in asked if name in known}, "trust": trust})).problem
    count = len(table["f"])
    if not 0 <= number < count:
        raise BadInput(
            f"Expected a failure from 0 to {count - 1}, got {number}." if count else "The run has no failure."
        )
    x = np.concatenate([np.atleast_1d(table[name][number]) for name in problem.space.names])
    return Found(problem, x, float(table["f"][number]), float(table["log_p0"][number]), count)


@torch.inference_mode()
def drive_again(problem: DrivingProblem, x: NDArray[np.float64]) -> Drive:
    """Drive one scenario and keep every moment.

    Args:
        problem: The world and its ego.
        x: Scenario parameters, shape (d,).
    """
    world = problem.world.with_statistics()
    episodes: list[Episode] = []
    # single precision, as in `DrivingProblem.evaluate`, so that f comes out the same
    for episode in drive(world, problem.driver, torch.from_numpy(x).float()[None]):
        episodes.append(episode)
        if bool(episode.collided):
            break
    alone = []
    for before, episode in zip([None, *episodes], episodes, strict=False):
        state = None if before is None else before.state
        moment = Moment(episode.state, episode.lead, episode.road, episode.perception, state, world.clock.dt)
        alone.append(float(episode.measure.f(episode.measure.start(moment, world.clock.ticks))))
    return Drive(problem, episodes, np.array([float(each.f) for each in episodes]), np.array(alone))


def pictures(drive: Drive) -> list[Image.Image]:
    """One picture for each moment, the road above the curves."""
    renderer = Renderer(drive.problem.world)
    curves, place = _curves(drive)
    shown = []
    for k, episode in enumerate(drive.episodes):
        road = renderer.draw(episode, drive.time(k))
        picture = Image.new("RGB", (WIDTH, road.shape[0] + STRIP))
        picture.paste(Image.fromarray(road), (0, 0))
        picture.paste(curves, (0, road.shape[0]))
        column, top, bottom = place(drive.time(k))
        ImageDraw.Draw(picture).line(
            [(column, road.shape[0] + top), (column, road.shape[0] + bottom)], fill=(200, 0, 150), width=2
        )
        shown.append(picture)
    return shown


def _curves(drive: Drive) -> tuple[Image.Image, Any]:
    """The measure over time, and where a time is in that picture: column, top and bottom [pixels]."""
    world = drive.problem.world
    time = np.arange(len(drive.so_far)) * world.clock.dt
    name = world.measurement.measure if isinstance(world.measurement.measure, str) else "measure"
    figure = Figure(figsize=(WIDTH / 100, STRIP / 100), dpi=100)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.08, 0.3, 0.9, 0.62))
    axes.plot(time, drive.alone, color="tab:blue", linewidth=1, label="this moment")
    axes.step(time, drive.so_far, where="post", color="black", linewidth=1.5, label="f so far")
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
        return round(column), round(STRIP - box.y1), round(STRIP - box.y0)

    return picture, place


def in_words(found: Found, drive: Drive, number: int) -> list[str]:
    """What happened, line by line."""
    space, labels = found.problem.space, found.problem.world.scenario.labels
    lines = [
        f"Failure {number} of {found.of} in {found.problem.env_id}: f = {drive.f:.4g}, log p0 = {found.log_p0:.2f}"
    ]
    for name, values in space.named(found.x).items():
        unit = space.units[space.names.index(name)]
        several = np.atleast_1d(values)
        shown = " ".join(map(digits, several)) if len(several) <= SHOWN else f"{len(several)} values"
        lines.append(f"  {name:<15} {shown} {unit}".rstrip())
    end = drive.time(len(drive.episodes) - 1)
    crash = drive.crash
    if crash is None:
        lines.append(
            f"No crash within {end:.1f} s; the worst moment was at {drive.time(int(drive.so_far.argmin())):.1f} s."
        )
    else:
        who, whom = ("the edge of the road" if j < 0 else labels[j] for j in crash["vehicles"])
        how = f"{crash['kind']}, closing at {crash['closing_speed']:.1f} m/s"
        lines.append(f"Crash after {end:.1f} s: {who} into {whom} ({how}).")
    if abs(drive.f - found.f) > SAME:
        why = "ego, drivers or this program have changed since"
        if found.problem.varies:
            why = "the ego answers differently from run to run, and what was recorded is what counts"
        lines.append(f"warning: the run recorded f = {found.f:.4g}; {why}.")
    return lines


def check_film(path: Path | str) -> None:
    """Refuse a name whose pictures cannot be written.

    Raises:
        BadInput: It ends neither in .gif nor in .png, or its folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in (".gif", ".png"):
        raise BadInput(f"Expected a file that ends in .gif (the drive) or .png (its worst moment), got {str(path)!r}.")
    if not path.parent.is_dir():
        raise BadInput(f"There is no folder {str(path.parent)!r}.")


def write_film(path: Path | str, drive: Drive, width: int = WIDTH, every: int = 1) -> None:
    """Write a drive as a moving picture (.gif), or its worst moment (.png).

    Args:
        path: The file.
        drive: What to show.
        width: Of the pictures [pixels].
        every: Show one tick out of so many.

    Raises:
        BadInput: See `check_film`.
    """
    check_film(path)
    path = Path(path)
    shown = pictures(drive)
    shown = [each.resize((width, round(each.height * width / WIDTH)), Image.Resampling.LANCZOS) for each in shown]
    if path.suffix.lower() == ".png":
        shown[int(np.argmin(drive.so_far))].save(path)
        return
    tick = round(1000 * drive.problem.world.clock.dt)
    kept = shown[:-1:every]
    frames = [each.quantize(COLOURS) for each in (*kept, shown[-1])]
    durations = [tick * every] * len(kept) + [tick * LAST]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)
