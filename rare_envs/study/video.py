"""Film of a drive: the road, and the safety measure over time below it."""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from rare_envs.envs.rendering import (
    AGENT,
    CRASH_COLOUR,
    FRAME_WIDTH,
    OTHER_COLOURS,
    ROLE_COLOURS,
    Colour,
    Renderer,
    as_rgb,
)
from rare_envs.files import replace_file
from rare_envs.study.arguments import BadInput, output_file
from rare_envs.study.plots import draw_measure
from rare_envs.study.replay import Drive

CURVES_HEIGHT = 144
"""Height of the curves below the road of a film [pixels]."""
LAST_FRAME_TICKS = 10
"""Ticks for which the last picture stays."""
MARKER: Colour = (200, 0, 150)
"""Line at the present moment in the curves."""


def draw_frames(drive: Drive) -> list[Image.Image]:
    """Return one picture for each moment, the road above the curves."""
    renderer, shown = Renderer(drive.problem.world), []
    curves, columns, (top, bottom) = _draw_curves(drive)
    for k, episode in enumerate(drive.episodes):
        road = renderer.draw(episode, drive.time[k])
        below = curves.copy()
        ImageDraw.Draw(below).line([(columns[k], top), (columns[k], bottom)], fill=MARKER, width=2)
        picture = Image.new("RGB", (FRAME_WIDTH, road.shape[0] + CURVES_HEIGHT))
        picture.paste(Image.fromarray(road), (0, 0))
        picture.paste(below, (0, road.shape[0]))
        shown.append(picture)
    return shown


def _draw_curves(drive: Drive) -> tuple[Image.Image, list[int], tuple[int, int]]:
    """Return the measure over time as a picture; the column of each moment in it, and the ends of the axes [pixels]."""
    measure = drive.problem.world.measurement.measure
    figure = Figure(figsize=(FRAME_WIDTH / 100, CURVES_HEIGHT / 100), dpi=100)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.08, 0.3, 0.9, 0.62))
    draw_measure(axes, drive)
    axes.set_xlim(0.0, max(drive.problem.world.clock.dt, float(drive.time[-1])))
    axes.set_ylabel(measure if isinstance(measure, str) else "measure")
    axes.xaxis.label.set_fontsize(8)
    axes.yaxis.label.set_fontsize(8)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=7, loc="upper right", frameon=False)
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
    """Write pictures, one for each tick of dt [s], as a moving one that shows one out of `every`; the last stays."""
    tick, kept = round(1000 * dt), shown[:-1:every]
    palette = _make_gif_palette()
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in (*kept, shown[-1])]
    durations = [tick * every] * len(kept) + [tick * LAST_FRAME_TICKS]
    more: dict[str, Any] = {"append_images": frames[1:], "duration": durations, "loop": 0, "optimize": True}
    frames[0].save(file, format="GIF", save_all=True, **more)
