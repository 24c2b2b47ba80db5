"""Failures of a run, read again from failures.csv and failures.npz."""

from __future__ import annotations

import csv
import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.files import check_ordinary, read_text_file
from rare_envs.plugins import one_line
from rare_envs.study.storage.names import BLOCKS, FAILURES

MAX_BLOCK_BYTES = 1 << 30
"""Bytes of blocks that are unpacked at most: a thousand failures with a quarter of a million values each."""
CRASH = (
    "crash",
    "striking",
    "struck",
    "impact_speed",
    "closing_speed",
    "delta_v_striking",
    "delta_v_struck",
    "injury_risk_striking",
    "injury_risk_struck",
)
"""Columns of failures.csv that say what a failure ended in: `rare_envs.traffic.crash.Crash`."""


def read_failures(folder: Path) -> dict[str, NDArray[Any]]:
    """Read the failures of a run, the most likely first.

    Args:
        folder: Of `rare-envs estimate --out`.

    Returns:
        Parameters by name, shape (n,), or (n, size) for blocks; then "f" and "log_p0", shape (n,), and what the
        failure ended in: "crash" (words) and the numbers of `CRASH`, NaN without a crash. The parameters of row k
        replay by `env.reset(options={name: failures[name][k] for name in env.unwrapped.space.names})`.

    Raises:
        FileNotFoundError: There is no such run.
        ValueError: One of its files is damaged.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from rare_envs.study import Question, prepare, run_into
        >>> question = Question(
        ...     env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=1000
        ... )
        >>> with TemporaryDirectory() as folder:
        ...     report = run_into(Path(folder), prepare(question))
        ...     failures = read_failures(Path(folder))
        >>> failures["gap"].shape, str(failures["crash"][0]), round(float(failures["f"][0]), 2)
        ((21,), 'none', 2.57)
    """
    try:
        failures = _read_table(folder / FAILURES)
    except (csv.Error, ValueError) as error:
        raise ValueError(f"{str(folder / FAILURES)!r} is damaged: {str(error).rstrip('.')}.") from error
    if (folder / BLOCKS).exists():
        failures |= _read_blocks(folder / BLOCKS)
    lengths = {name: len(values) for name, values in failures.items()}
    if not {"f", "log_p0"} <= set(lengths) or len(set(lengths.values())) > 1:
        raise ValueError(f"The files of failures in {str(folder)!r} are damaged: they do not have the same rows.")
    return failures


def _read_table(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns of a table by name."""
    header, *rows = csv.reader(io.StringIO(read_text_file(path))) or [[]]
    if any(len(row) != len(header) for row in rows):
        raise ValueError("a row has more or fewer cells than the header")
    columns: dict[str, list[NDArray[Any]]] = {}
    for column, name in enumerate(header):
        cells = [row[column] for row in rows]
        words = name == CRASH[0]
        values = np.array(cells, dtype=str) if words else np.array([float(cell or "nan") for cell in cells])
        columns.setdefault(name.partition("[")[0], []).append(values)
    return {name: parts[0] if len(parts) == 1 else np.stack(parts, axis=1) for name, parts in columns.items()}


def _read_blocks(path: Path) -> dict[str, NDArray[Any]]:
    """Return the large blocks by name, shape (n, size)."""
    try:
        check_ordinary(path)
        with zipfile.ZipFile(path) as archive:
            if sum(each.file_size for each in archive.infolist()) > MAX_BLOCK_BYTES:
                raise ValueError(f"more than {MAX_BLOCK_BYTES:,} bytes unpacked")
        with np.load(path, allow_pickle=False) as blocks:
            found = {name: np.asarray(blocks[name]) for name in blocks.files}
        if any(block.dtype.kind != "f" or block.ndim != 2 for block in found.values()):
            raise ValueError("a block is no table of numbers")
    except Exception as error:  # the zip, its compression and NumPy's headers have errors of their own
        raise ValueError(f"{str(path)!r} is damaged: {one_line(error)}.") from error
    return {name: block.astype(np.float64) for name, block in found.items()}
