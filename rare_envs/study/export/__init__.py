"""Front door of the exports: a scenario is driven, and written in one of the formats."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.plugins import did_you_mean
from rare_envs.problem import DrivingProblem
from rare_envs.startup import __version__
from rare_envs.study.export.commonroad import write_commonroad
from rare_envs.study.export.openscenario import Story, write_road
from rare_envs.study.replay import Drive, drive_again, find_trajectories

__all__ = ["EXPORT_FORMATS", "export_drive", "export_scenario"]

EXPORT_FORMATS = {
    "openscenario": "ASAM OpenSCENARIO XML 1.2 (.xosc) with its road as OpenDRIVE 1.6 (.xodr) beside it",
    "carla": "the same in OpenSCENARIO 1.0 for CARLA's scenario_runner, with a free ego",
    "commonroad": "CommonRoad XML 2020a (.xml)",
}
"""Formats of `export_drive`, in words."""
_ENDINGS = {"openscenario": ".xosc", "carla": ".xosc", "commonroad": ".xml"}
_MARGIN = 150.0
"""Road before the first and after the last place of a vehicle [m], for egos that drive on."""


def export_scenario(
    problem: DrivingProblem,
    x: ArrayLike,
    path: Path | str,
    format: str = "openscenario",
    ego: Literal["recorded", "free"] | None = None,
) -> tuple[Path, ...]:
    """Drive a scenario x (d,) of a problem and write it for other simulators; see `export_drive`.

    Returns:
        The files written.

    Raises:
        ValueError: An argument is not as described, or a library is missing.
        OSError: A file cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> problem = DrivingProblem("rare_envs/CarFollowing-v0")
        >>> with TemporaryDirectory() as folder:
        ...     files = export_scenario(problem, [20.0, 5.0, 10.0], Path(folder) / "crash.xml", "commonroad")
        ...     [file.name for file in files]
        ['crash.xml']
    """
    row = problem.space.validate(np.atleast_2d(np.asarray(x, dtype=np.float64)))
    if len(row) != 1:
        raise ValueError(f"Expected one scenario of shape ({problem.dim},), got {len(row)}.")
    check_export(path, format, ego)
    named = {name: value for name, value in problem.space.named(row[0]).items() if np.size(value) == 1}
    drive = drive_again(problem, row[0])
    properties = {"f": repr(drive.f), **{name: repr(float(value)) for name, value in named.items()}}
    return export_drive(drive, path, format, ego, properties)


def export_drive(
    drive: Drive,
    path: Path | str,
    format: str = "openscenario",
    ego: Literal["recorded", "free"] | None = None,
    properties: dict[str, str] | None = None,
) -> tuple[Path, ...]:
    """Write a drive for other simulators.

    Args:
        drive: The drive.
        path: The file: `.xosc`, beside which the road is written as `.xodr`, or `.xml` for CommonRoad. Its folder is
            made if there is none.
        format: One of `EXPORT_FORMATS`.
        ego: "recorded", the ego follows its trajectory as the others do; or "free", it is put to its place with its
            speed, and whoever simulates drives it. None for "free" with CARLA and "recorded" otherwise.
        properties: For the header of OpenSCENARIO 1.2.

    Returns:
        The files written.

    Raises:
        ValueError: An argument is not as described, or the library scenariogeneration is missing.
        OSError: A file cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> problem = DrivingProblem("rare_envs/CarFollowing-v0", horizon=1.0)
        >>> drive = drive_again(problem, np.array([20.0, 15.0, 30.0]))
        >>> with TemporaryDirectory() as folder:
        ...     (file,) = export_drive(drive, Path(folder) / "drive.xml", "commonroad", ego="free")
        ...     file.read_text().count("<dynamicObstacle")
        1
    """
    path = Path(path)
    free = check_export(path, format, ego)
    trajectories, road = find_trajectories(drive), drive.road
    along = drive.position[..., 0]
    start, end = float(np.floor(along.min() - _MARGIN)), float(np.ceil(along.max() + _MARGIN))
    title = f"{drive.problem.env_id}, f = {drive.f:.4g}"
    path.parent.mkdir(parents=True, exist_ok=True)
    if format == "commonroad":
        write_commonroad(path, trajectories, road, (start, end), title, free)
        return (path,)
    road_path = path.with_suffix(".xodr")
    write_road(road_path, road, start, end, drive.problem.world.scenario.name)
    about = {"env_id": drive.problem.env_id, "rare_envs": __version__, **(properties or {})}
    Story(trajectories, free, carla=format == "carla").write(path, road_path.name, title, about)
    return path, road_path


def check_export(path: Path | str, format: str, ego: str | None) -> bool:
    """Return whether the ego is left free."""
    if format not in EXPORT_FORMATS:
        raise ValueError(
            f"Expected a format of {', '.join(EXPORT_FORMATS)}, got {format!r}{did_you_mean(format, EXPORT_FORMATS)}."
        )
    path = Path(path)
    if path.suffix.lower() != _ENDINGS[format]:
        others = [name for name, ending in _ENDINGS.items() if ending == path.suffix.lower()]
        hint = f"; --format {others[0]} writes such a file" if others else ""
        raise ValueError(f"Expected a file that ends in {_ENDINGS[format]} for {format}, got {str(path)!r}{hint}.")
    if ego not in ("recorded", "free", None):
        raise ValueError(f"Expected an ego recorded or free, got {ego!r}.")
    if format == "carla" and ego == "recorded":
        raise ValueError("In CARLA's scenario_runner the ego is free; --format openscenario has it recorded.")
    return ego == "free" or format == "carla"
