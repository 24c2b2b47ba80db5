"""Writing of the folder of a run: study.json at its beginning, results, tables and pictures at its end."""

from __future__ import annotations

import csv
import hashlib
import platform
import shlex
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import samplers
from agents.loading import find_ego_kind, strip_prefixes
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.files import format_json, parse_json_object, read_text_file, replace_file, replace_text
from rare_envs.study.arguments import Question
from rare_envs.study.columns import MAX_SHOWN, list_columns
from rare_envs.study.errors import BadInput
from rare_envs.study.journal import digest_contents, digest_files, find_ego_files
from rare_envs.study.plots import save_plot, save_sensitivity, save_severity
from rare_envs.study.question import Study
from rare_envs.study.recorded_question import describe_places, is_same_question
from rare_envs.study.report import Report
from rare_envs.study.run_folder import (
    CRASH,
    FAILURES,
    FAULT_BLOCKS,
    FAULTS,
    PLOT,
    RESULT,
    RESULT_FILES,
    SENSITIVITY,
    SEVERITY,
    STUDY,
    STUDY_FORMAT,
    digest_results,
)
from rare_envs.traffic.crash import CRASH_KINDS, NONE
from rare_envs.version import __version__
from samplers.result import method_settings


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
    """Raise a BadInput if a folder has results of a finished run, or files of these names."""
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


LIBRARIES = (
    "cvxpy",
    "gymnasium",
    "highway-env",
    "numba",
    "numpy",
    "onnxruntime",
    "scikit-learn",
    "scipy",
    "stable-baselines3",
    "torch",
)
"""Distributions whose versions may change a number."""


def describe_study(study: Study, folder: Path = Path()) -> dict[str, Any]:
    """Return what study.json holds at the beginning of a run, whose folder is given."""
    question, space = study.question, study.problem.space
    files = digest_files(question)
    rows = zip(space.names, space.units, space.sizes, strict=True)
    return {
        "format": STUDY_FORMAT,
        "command": _describe_command(sys.argv),
        "begun": _now(),
        "finished": None,
        "seconds": None,
        "seed": question.seed,
        "gamma": question.gamma,
        "ego": _describe_ego(question),
        "base": _describe_base(study),
        "method": {"name": study.method.name, "settings": method_settings(study.method)},
        "parameters": [{"name": name, "unit": unit, "size": int(size)} for name, unit, size in rows],
        "question": asdict(question),
        "files": files,
        "file_places": describe_places(files, folder),
        "versions": find_versions(),
        "platform": platform.platform(),
    }


def begin_study_file(folder: Path, study: Study) -> None:
    """Write study.json of a run that begins."""
    replace_text(folder / STUDY, format_json(describe_study(study, folder)) + "\n")


def note_resumption(folder: Path, earlier_seconds: float) -> None:
    """Note in study.json that an interrupted run goes on; one that cannot be read or written is left as it is.

    Args:
        folder: Of the run.
        earlier_seconds: Wall time of the run before it was interrupted [s].
    """
    with suppress(OSError, ValueError):  # a full disk is found when results are written
        about = parse_json_object(read_text_file(folder / STUDY), STUDY)
        about |= {"resumed": _now(), "earlier_seconds": earlier_seconds}
        replace_text(folder / STUDY, format_json(about) + "\n")


def finish_study_file(folder: Path, study: Study, seconds: float) -> None:
    """Note in study.json that the run is done, and the digests of its files; what it held of the beginning stays.

    A study.json of another question, which somebody has put there, is written anew.

    Args:
        folder: Of the run.
        study: What was asked.
        seconds: Wall time, that before interruptions included [s].
    """
    try:
        begun = parse_json_object(read_text_file(folder / STUDY), STUDY)
    except (OSError, ValueError):  # of an earlier version, or somebody has removed it
        begun = {"question": None}
    if "question" in begun and not is_same_question(begun["question"], study.question):
        begun = describe_study(study, folder)
    ended = {"finished": _now(), "seconds": seconds, "results": digest_results(folder)}
    replace_text(folder / STUDY, format_json({**begun, **ended}) + "\n")


def find_versions() -> dict[str, str]:
    """Return the versions of this program, Python and the libraries that are installed."""
    found = {"rare-envs": __version__, "python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _describe_ego(question: Question) -> dict[str, Any]:
    """Return name, kind and fingerprint of the ego: of its files, or of this version where it comes with it."""
    files = digest_contents(find_ego_files(question))
    rests_on = "".join(sorted(files.values())) or f"{question.ego} of rare-envs {__version__}"
    return {
        "name": question.ego,
        "kind": find_ego_kind(strip_prefixes(question.ego)),
        "files": files,
        "fingerprint": hashlib.blake2b(rests_on.encode(), digest_size=16).hexdigest(),
    }


def _describe_base(study: Study) -> Mapping[str, Any]:
    base = study.base
    fit = {"fitted_to": base.fitted_to, "family": base.family} if isinstance(base, FittedDistribution) else {}
    return {"name": study.base_name, "fitted_to": "", "family": "", **fit}


def _describe_command(words: list[str]) -> str:
    """Return the command line that was typed; empty where another program runs."""
    program = Path(words[0]) if words else Path()
    ours = program.stem == "rare-envs" or program.parts[-2:] == ("rare_envs", "__main__.py")
    return shlex.join(["rare-envs", *words[1:]]) if ours else ""


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
