"""Folder of a run: result.json, failures.csv (and failures.npz), plot.png, severity.png, faults.csv, sensitivity.png.

Until the run is done, its finished simulations are there too, see `rare_envs.study.journal`; `evaluate` runs it.
"""

from __future__ import annotations

import csv
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import samplers
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.files import replace_file, replace_text
from rare_envs.plugins import one_line
from rare_envs.study.analysis.pictures import save_sensitivity, save_severity
from rare_envs.study.columns import MAX_SHOWN, list_columns
from rare_envs.study.errors import BadInput
from rare_envs.study.plots import save_plot
from rare_envs.study.report import Report
from rare_envs.traffic.crash import CRASH_KINDS, NONE

RESULT, FAILURES, BLOCKS, PLOT = "result.json", "failures.csv", "failures.npz", "plot.png"
"""Blocks are what a table has no room for: of more than `columns.MAX_SHOWN` values, drivers' weights and noise."""
SENSITIVITY = "sensitivity.png"
"""Bars of what p is sensitive to, if the question asks for it."""
SEVERITY = "severity.png"
"""P[collision with delta-v > v] over v, if there are collisions."""
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
FAULTS, FAULT_BLOCKS = "faults.csv", "faults.npz"
"""The same for scenarios on which the ego failed."""
RESULT_FILES = (RESULT, FAILURES, BLOCKS, PLOT, SENSITIVITY, SEVERITY, FAULTS, FAULT_BLOCKS)


def write_run(folder: Path, report: Report) -> None:
    """Write a report, the numbers before the picture.

    Args:
        folder: An existing folder; files of an earlier run in it are replaced.
        report: What to write.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from rare_envs.study import Question, prepare, run
        >>> report = run(prepare(Question(env_id="rare_envs/CarFollowing-v0", method="mc", max_sim=100, horizon=1.0)))
        >>> with TemporaryDirectory() as folder:
        ...     write_run(Path(folder), report)
        ...     json.loads((Path(folder) / "result.json").read_text())["status"]
        'no_hits'
    """
    replace_text(folder / RESULT, format_json(report.to_dict()) + "\n")
    _write_failures(folder, report)
    _write_faults(folder, report)
    save_plot(folder / PLOT, report)
    for name in (SENSITIVITY, SEVERITY):
        (folder / name).unlink(missing_ok=True)
    if isinstance(report.sensitivity, samplers.Sensitivity):
        save_sensitivity(folder / SENSITIVITY, report.sensitivity)
    if report.kinds.severity is not None:
        save_severity(folder / SEVERITY, report.kinds.severity)


def check_no_results(folder: Path, *names: str) -> None:
    """Raise a BadInput if a folder has results of a finished run, or files of these names.

    Args:
        folder: It need not exist.
        names: Names of further files.

    Raises:
        BadInput: It has one of them.
    """
    for name in (RESULT, FAILURES, *names):
        if (folder / name).exists():
            raise BadInput(f"There is a finished run in {str(folder)!r} ({name}): replace it by --force.")


def remove_results(folder: Path) -> None:
    """Remove the files of a finished run, and drafts that one left which was killed while it wrote."""
    drafts = [path for name in RESULT_FILES for path in folder.glob(f".{Path(name).stem}.*.part{Path(name).suffix}")]
    for path in (*(folder / name for name in RESULT_FILES), *drafts):
        path.unlink(missing_ok=True)


def format_json(value: dict[str, Any]) -> str:
    """Return JSON with one entry per line, but lists of numbers in one line."""
    text = json.dumps(value, indent=2, allow_nan=False)
    # a line that ends with a bracket is no part of a string, which would have no line breaks
    return re.sub(r"\[\n([^\[\]{}\"]*)\n *\]", lambda match: f"[{' '.join(match[1].split())}]", text)


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
        raise ValueError(f"{str(folder / FAILURES)!r} is damaged: {error}.") from error
    if (folder / BLOCKS).exists():
        failures |= _read_blocks(folder / BLOCKS)
    lengths = {name: len(values) for name, values in failures.items()}
    if not {"f", "log_p0"} <= set(lengths) or len(set(lengths.values())) > 1:
        raise ValueError(f"The files of failures in {str(folder)!r} are damaged: they do not have the same rows.")
    return failures


def _read_table(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns of a table by name.

    Raises:
        ValueError: It is no table, or a cell is no number.
    """
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file) or [[]]
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
    """Return the large blocks by name, shape (n, size).

    Raises:
        ValueError: The file is damaged.
    """
    try:
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


def _write_failures(folder: Path, report: Report) -> None:
    """Write one failure per row, the most likely first: x, f, log p0 and the crash."""
    kind = "" if report.kinds.unknown else CRASH_KINDS[NONE]
    crashes = [_crash_columns(crash, kind) for crash in report.crashes]
    write_failures(folder, report.study.problem.space, report.estimate.failures, CRASH, crashes)


def write_failures(
    folder: Path,
    space: ScenarioSpace,
    failures: samplers.Failures,
    names: tuple[str, ...] = (),
    more: list[tuple[Any, ...]] | None = None,
) -> None:
    """Write `FAILURES`: one failure a row, the most likely first: x, f, log p0, and what more there is, by name."""
    # repr of a float gives it back exactly, so that a row replays to the same f
    rest = [(one.f, one.log_p0, *extra) for one, extra in zip(failures, more or [()] * len(failures), strict=True)]
    _write_table(folder / FAILURES, space, failures.x, ("f", "log_p0", *names), rest)


def _crash_columns(crash: dict[str, Any] | None, kind: str) -> tuple[Any, ...]:
    """Return a crash as the columns `CRASH`; `kind` and blanks where there is none."""
    if crash is None:
        return (kind, *("" for _ in CRASH[1:]))
    speeds = (crash["impact_speed"], crash["closing_speed"])
    return (crash["kind"], *crash["vehicles"], *speeds, *crash["delta_v"], *crash["injury_risk"])


def _write_faults(folder: Path, report: Report) -> None:
    """Write one scenario per row on which the ego failed: x and the reason; no file without one."""
    space, faults = report.study.problem.space, report.faults
    for name in (FAULTS, FAULT_BLOCKS):
        (folder / name).unlink(missing_ok=True)
    if faults:
        x = np.stack([fault.x for fault in faults])
        _write_table(folder / FAULTS, space, x, ("reason",), [(fault.reason,) for fault in faults])


def _write_table(
    path: Path, space: ScenarioSpace, x: NDArray[np.float64], names: tuple[str, ...], rest: list[tuple[Any, ...]]
) -> None:
    """Write scenarios, one per row.

    The table has the columns of x by name but for large blocks, then the rest. Large blocks go row by row into a file
    of arrays beside it, in single precision, in which they are simulated, so that they replay to the same f.
    """
    columns = list_columns(space)
    shown = [column.shown for column in columns]
    with replace_file(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*(column.name for column in columns if column.shown), *names])
        writer.writerows([*row[shown].tolist(), *more] for row, more in zip(x, rest, strict=True))
    large = {name for name, size in zip(space.names, space.sizes, strict=True) if size > MAX_SHOWN}
    blocks_path = path.with_suffix(".npz")
    blocks_path.unlink(missing_ok=True)
    if large:
        blocks = {name: part.astype(np.float32) for name, part in space.columns(x).items() if name in large}
        with replace_file(blocks_path) as draft:
            np.savez_compressed(draft, allow_pickle=False, **blocks)
