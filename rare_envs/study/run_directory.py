"""Folder of a run: result.json, failures.csv (and failures.npz), plot.png, severity.png, faults.csv, sensitivity.png.

Until the run is done, its finished simulations are there too, see `rare_envs.study.journal`; `evaluate` runs it.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import samplers
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.files import replace_file, replace_text
from rare_envs.json_text import format_json
from rare_envs.study.analysis.pictures import save_sensitivity, save_severity
from rare_envs.study.columns import MAX_SHOWN, list_columns
from rare_envs.study.errors import BadInput
from rare_envs.study.plots import save_plot
from rare_envs.study.report import Report
from rare_envs.study.storage.failure_table import CRASH
from rare_envs.study.storage.names import (
    FAILURES,
    FAULT_BLOCKS,
    FAULTS,
    PLOT,
    RESULT,
    RESULT_FILES,
    SENSITIVITY,
    SEVERITY,
)
from rare_envs.traffic.crash import CRASH_KINDS, NONE


def write_run(folder: Path, report: Report) -> None:
    """Write a report, the numbers before the picture.

    Args:
        folder: An existing folder; files of an earlier run in it are replaced.
        report: What to write.

    Example:
        >>> import json
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
    """Remove the files of a finished run, and drafts of them."""
    for name in RESULT_FILES:
        (folder / name).unlink(missing_ok=True)
    remove_drafts(folder)


def remove_drafts(folder: Path) -> None:
    """Remove the drafts of a run that was killed while it wrote, see `rare_envs.files.replace_file`."""
    for name in map(Path, RESULT_FILES):
        for draft in folder.glob(f".{name.stem}.*.part{name.suffix}"):
            draft.unlink(missing_ok=True)


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
            # allow_pickle=False, as its types would like, is a block to NumPy 2.0
            np.savez_compressed(draft, **blocks)  # type: ignore[arg-type]
