"""Road of Interstate 80 at Emeryville, fitted to its survey and written as the table of the package.

    python -m training.recipes.i80_road FOLDER [--out rare_envs/data/i80.json]

FOLDER holds `lanes.csv` (lane, s, x, y: points on the centre lines of six lanes, lane 0 the rightmost) and
`boundaries.csv` (boundary, x, y: the lines to the left of those lanes), in metres, y positive to the left of x. The
reference line is a `rare_envs.traffic.road.ReferenceLine` in the middle of the leftmost lane. Its curvatures,
its start and a constant distance to each other lane are fitted by least squares to all lanes but the rightmost, which
bends towards two ramps.
"""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from scipy.optimize import least_squares

from rare_envs.files import replace_text
from rare_envs.traffic.road import ReferenceLine, Road
from samplers.problem import FloatArray
from training.command_line import report_errors, run_command
from training.data.columns import Column, read_table

ROAD_COMMAND = "python -m training.recipes.i80_road FOLDER"
SURVEY_SOURCE = (
    "Survey drawings of the NGSIM I-80 study section, Emeryville, California (FHWA), as released with "
    "travelbureau/RareSim (MIT licence); fitted by a curve with piecewise linear curvature and constant lane offsets."
)
SURVEY_LANES = 6
"""Number of surveyed lanes."""
KNOT_SPACING = 50.0
"""Distance between knots of the curvature [m]. With half of it the fit is 1 cm better and the curvature twice as
uneven."""
CURVE_LENGTH = 700.0
"""Length of the curve [m]: that of the survey, rounded up to whole knots."""
SURVEYED = 650.0
"""Distance along the road [m] up to which all lanes and lines were surveyed."""
THINNING = 3
"""Every third point of the survey is fitted; they are 1.5 m apart."""


def read_lines(path: Path, key: str) -> list[FloatArray]:
    """Return the six lines of a survey file (n, 2), in the order of the numbers that the column `key` has."""
    rows = read_table(path, {name: Column((name,)) for name in (key, "x", "y")})
    rows.refuse(~np.isin(rows[key], range(SURVEY_LANES)), f"expected {key} 0 to {SURVEY_LANES - 1}.")
    points = np.column_stack((rows["x"], rows["y"]))
    return [points[rows[key] == k] for k in range(SURVEY_LANES)]


def to_frame(points: FloatArray, origin: FloatArray, angle: float, side: float = -1.0) -> FloatArray:
    """Return points (n, 2) in the frame at `origin` with x in direction `angle` and y to the right, or left (1)."""
    cos, sin = np.cos(angle), np.sin(angle)
    dx, dy = (points - origin).T
    return np.column_stack((dx * cos + dy * sin, side * (dy * cos - dx * sin)))


def find_across(points: FloatArray, curve: ReferenceLine, surveyed: bool = True) -> FloatArray:
    """Return distances across the road of points (n, 2) [m], of those where all was surveyed, or of all."""
    x, y = torch.from_numpy(points).unbind(dim=1)
    s, across, _ = (values.numpy() for values in Road((-1.0, 1.0), curve).from_world(x, y, torch.zeros_like(x)))
    return across[(s >= 0.0) & (s <= SURVEYED)] if surveyed else across


def fit_reference_line(lanes: list[FloatArray]) -> tuple[ReferenceLine, FloatArray, float]:
    """Return the reference line, and the origin and angle of its frame in the survey's."""
    leftmost = lanes[-1]
    origin = leftmost[0]
    angle = float(np.arctan2(*(leftmost[len(leftmost) // 10] - origin)[::-1]))
    fitted = [to_frame(lane[::THINNING], origin, angle) for lane in lanes[1:]]
    knots = round(CURVE_LENGTH / KNOT_SPACING) - 1

    def unpack(z: FloatArray) -> tuple[ReferenceLine, FloatArray, float, FloatArray]:
        """Unknowns of order 1: curvatures [1e-4/m], turn [0.01 rad] and shift [m] of the frame, offsets [m]."""
        curve = ReferenceLine(KNOT_SPACING, (0.0, *(1e-4 * z[:knots]).tolist(), 0.0))
        return curve, np.array([0.0, z[knots + 1]]), 0.01 * z[knots], np.append(z[knots + 2 :], 0.0)

    def residuals(z: FloatArray) -> FloatArray:
        curve, start, turn, offsets = unpack(z)
        across = [find_across(to_frame(lane, start, turn, side=1.0), curve, surveyed=False) for lane in fitted]
        return np.concatenate([y - offset for y, offset in zip(across, offsets, strict=True)])

    guess = [float(lane[0, 1]) for lane in fitted[:-1]]
    curve, start, turn, _ = unpack(least_squares(residuals, np.array([*[0.0] * (knots + 2), *guess])).x)
    right = np.array([np.sin(angle), -np.cos(angle)])
    return curve, origin + start[1] * right, angle - turn


def main(
    folder: Annotated[Path, typer.Argument(help="Folder with lanes.csv and boundaries.csv.")],
    out: Annotated[Path, typer.Option(help="The file to write.")] = Path("rare_envs/data/i80.json"),
) -> None:
    """Fit the road, print how well it fits, and write the table."""
    with report_errors("i80_road"):
        lanes, lines = read_lines(folder / "lanes.csv", "lane"), read_lines(folder / "boundaries.csv", "boundary")
    curve, origin, angle = fit_reference_line(lanes)
    curve = ReferenceLine(KNOT_SPACING, tuple(round(k, 9) for k in curve.curvature))
    lanes, lines = ([to_frame(points, origin, angle) for points in group] for group in (lanes, lines))
    *edges, lane = (float(np.median(find_across(points, curve))) for points in (*reversed(lines), lanes[0]))
    edges.append(2.0 * lane - edges[-1])  # that on the right was not surveyed: it mirrors the line before
    road = Road(tuple(round(y, 3) for y in edges), curve)
    centres = tuple(road.centre(k) for k in range(SURVEY_LANES))
    for name, group, places in (("lines", lines, road.edges), ("lanes", lanes, centres)):
        each = [find_across(points, curve) - y for points, y in zip(reversed(group), places, strict=False)]
        off = np.abs(np.concatenate(each))
        typer.echo(f"{name} are off by {np.sqrt(np.mean(off**2)):.3f} m rms, {off.max():.3f} m at most")
    shape = {"spacing": KNOT_SPACING, "edges": road.edges, "curvature": curve.curvature}
    replace_text(out, json.dumps({"source": SURVEY_SOURCE, "command": ROAD_COMMAND, **shape}, indent=1) + "\n")
    typer.echo(out)


if __name__ == "__main__":
    run_command(main)
