"""I-80 by Coifman and Li (2017): the NGSIM recording of one camera, extracted from the video again by hand.

The publication is a MATLAB file with a matrix `data` of NGSIM's 18 columns and a text `note`. Seven of the columns are
filled: vehicle, frame (0.1 s) and leader with NGSIM's numbers, `Local_Y` [ft], speed [ft/s], acceleration [ft/s^2] and
lane. `Local_Y` is that of the **rear** bumper, where NGSIM's is that of the front: the authors' comparison takes
NGSIM's `Local_Y` less its length, and so does a comparison of 10 770 rows with recorded lengths (mean difference
0.01 m). Positions across the road and lengths are zeros there, so y is NaN here and lengths are assumed, or taken from
a file of NGSIM.

Coifman, Li, "A critical evaluation of the Next Generation Simulation (NGSIM) vehicle trajectory dataset",
Transportation Research Part B 105, 2017, 362-377; the file's own note.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from samplers.problem import FloatArray
from training.data.formats.ngsim import FOOT, TEXT_COLUMNS, load_ngsim
from training.data.formats.text_columns import Gaps, Rows, check_tracks
from training.data.trajectories import DT, NOBODY, Trajectories, tabulate

MEAN_LENGTH = 4.87
"""Length [m] assumed of a vehicle whose length is not known: mean of 222 vehicles of this recording, from NGSIM."""
PLACES = {"vehicle": 0, "frame": 1, "y_along": 5, "speed": 11, "acceleration": 12, "lane": 13, "leader": 14}
"""Columns of the matrix that are filled, counted from 0; 15 is the follower."""
EMPTY_PLACES = {"Local_X": 4, "v_Length": 8}
"""Columns that are zero here, and filled in NGSIM's own files."""


def load_coifman_li(
    path: Path | str, *, ngsim: Path | str | None = None, length: float = MEAN_LENGTH, gaps: Gaps = "error"
) -> Trajectories:
    r"""Return the recording of Coifman and Li; it is named after the file.

    A gap is the distance of the rear bumpers less the length of the follower, so an assumed length shifts it.

    Args:
        path: The MATLAB file, or a text file of its 18 columns without a header, separated by blanks or commas.
        ngsim: Raw NGSIM file of the same period, for the lengths of the vehicles that are in both.
        length: Length assumed of all others [m].
        gaps: What is done where a vehicle is missing for some frames: "error" raises, "cut" cuts its track.

    Returns:
        The table, without lane boundaries; y and width are NaN. Lanes are numbered as in the file: 1 the leftmost, 6
        the rightmost, 9 to the right of that.

    Raises:
        ValueError: The file cannot be read, is another's, or holds impossible values.

    Example:
        >>> import pathlib, tempfile
        >>> rows = [f"7 {k} 0 0 0 {5 * k} 0 0 0 0 0 50 0 1 0 0 0 0" for k in range(1, 4)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "i80.txt"
        ...     _ = path.write_text("\n".join(rows))
        ...     table = load_coifman_li(path, length=4.0)
        >>> (table.x - 0.5 * table.length).round(3).tolist()
        [1.524, 3.048, 4.572]
    """
    path = Path(path)
    if not length > 0.0:
        raise ValueError(f"Expected a positive length, got {length:g}.")
    matrix = _read_mat(path) if path.suffix.lower() == ".mat" else _read_text(path)
    rows = Rows(path, {name: matrix[:, place] for name, place in PLACES.items()}, np.arange(1, 1 + len(matrix)))
    _check_matrix(rows, matrix)
    y_rear, speed = FOOT * rows["y_along"], FOOT * rows["speed"]
    check_tracks(rows, rows["vehicle"], rows["frame"], y_rear, speed, DT, gaps)
    lengths = np.full(len(rows), length) if ngsim is None else _known_lengths(rows["vehicle"], Path(ngsim), length)
    columns = {
        "recording": path.stem,
        "vehicle": rows["vehicle"],
        "frame": rows["frame"],
        "x": y_rear + 0.5 * lengths,
        "y": np.nan,
        "speed": speed,
        "acceleration": FOOT * rows["acceleration"],
        "length": lengths,
        "width": np.nan,
        "lane": rows["lane"],
        "leader": np.where(rows["leader"] > 0, rows["leader"], NOBODY),
    }
    return tabulate(columns)


def _read_mat(path: Path) -> FloatArray:
    """Return the matrix `data` of a MATLAB file."""
    try:
        content: dict[str, Any] = loadmat(path, variable_names=["data"])
    except (OSError, ValueError, TypeError, NotImplementedError, MatReadError, zlib.error) as error:
        raise ValueError(f"Cannot read {path}: {error}") from None
    data = content.get("data")
    if data is None:
        raise ValueError(f"{path} has no matrix 'data'; is it the file of Coifman and Li?")
    if np.ndim(data) != 2 or np.asarray(data).dtype.kind not in "fiu":
        raise ValueError(f"{path}: expected 'data' to be a matrix of numbers.")
    return np.asarray(data, dtype=np.float64)


def _read_text(path: Path) -> FloatArray:
    """Return the matrix in a text file."""
    try:
        with path.open(encoding="utf-8") as file:
            first = file.readline()
        if not first.strip():
            raise ValueError("it is empty.")
        matrix: FloatArray = np.loadtxt(path, ndmin=2, delimiter="," if "," in first else None)
    except (OSError, ValueError) as error:
        raise ValueError(f"Cannot read {path}: {error}") from None
    return matrix


def _check_matrix(rows: Rows, matrix: NDArray[Any]) -> None:
    """Check that a matrix has rows and the columns of this data set, and that what is filled is finite."""
    if matrix.shape[1] != TEXT_COLUMNS:
        raise ValueError(f"{rows.path} has {matrix.shape[1]} columns; expected the {TEXT_COLUMNS} of NGSIM.")
    if not len(rows):
        raise ValueError(f"{rows.path} has no rows.")
    for name in PLACES:
        bad = ~np.isfinite(rows[name])
        if bad.any():
            row = int(np.argmax(bad))
            raise rows.error(row, f"{name} is {rows[name][row]:g}, a number was expected.")
    filled = [name for name, place in EMPTY_PLACES.items() if (matrix[:, place] != 0.0).any()]
    if filled:
        raise ValueError(
            f"{rows.path} has values in {' and '.join(filled)}, which are empty in the data of Coifman and Li; is it a "
            "file of NGSIM's own, whose positions are those of the front?"
        )


def _known_lengths(vehicle: FloatArray, ngsim: Path, length: float) -> FloatArray:
    """Return lengths by the numbers of vehicles [m], shape (rows,): NGSIM's median, or the assumed one."""
    other = load_ngsim(ngsim, gaps="cut")
    numbers, index = np.unique(other.vehicle, return_inverse=True)
    order = np.lexsort([other.length, index.ravel()])
    starts = np.searchsorted(index.ravel()[order], np.arange(len(numbers) + 1))
    medians = other.length[order][(starts[:-1] + starts[1:] - 1) // 2]
    place = np.minimum(np.searchsorted(numbers, vehicle), len(numbers) - 1)
    known = numbers[place] == vehicle
    if not known.any():
        raise ValueError(f"{ngsim} has none of the vehicles; is it the recording of I-80 from 16:00 to 16:15?")
    return np.where(known, medians[place], length)
