"""Folder of a run: its files, and how they are read again without simulating; docs/using_results.md describes them."""

from __future__ import annotations

import csv
import io
import math
import reprlib
import shlex
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.files import (
    MAX_VALUES,
    digest_file,
    open_ordinary,
    open_parquet,
    read_json,
    read_members,
    read_text_file,
)
from rare_envs.plugins import one_line
from rare_envs.study.arguments import BadInput, as_bad_input

if TYPE_CHECKING:
    import pyarrow

JOURNAL = "journal.bin"
"""Finished simulations of a run that is not done; `samplers.journal` has its form and its promises."""
STUDY = "study.json"
"""What was asked, by what command and with which versions."""
STUDY_FORMAT = 1
"""Version of the fields of study.json; see docs/using_results.md."""
RESULT, FAILURES, BLOCKS = "result.json", "failures.csv", "failures.npz"
"""Blocks are what a table has no room for: of more than `columns.MAX_SHOWN` values, drivers' weights and noise."""
EPISODES = "episodes.parquet"
"""All simulations."""
REPORT = "report.html"
RISK, COMPARISON = "risk.json", "comparison.json"
"""What is in the folder of a risk, beside a run of each scenario, and in that of a comparison."""
SIDES = ("A", "B")
"""Of the egos of a comparison: folders of their journals, and f_A and f_B in its failures.csv."""
ANSWER, CRASH_STRIP, SCATTER = "answer.png", "crash.png", "failures.png"
"""The number; its most likely failure from above, and failures among ordinary traffic, if there are any."""
SENSITIVITY, SEVERITY = "sensitivity.png", "severity.png"
"""What p is sensitive to, if the question asks for it, and P[collision with delta-v > v], if some are above 1 m/s."""
PICTURES = (ANSWER, CRASH_STRIP, SCATTER, SENSITIVITY, SEVERITY)
FAULTS, FAULT_BLOCKS = "faults.csv", "faults.npz"
"""The same as of failures for scenarios on which the ego failed."""
EVIDENCE = "evidence"
"""Folder of what `rare_envs.study.evidence` writes."""
EVIDENCE_FILES = ("*.json", "claims.svg", "evidence.html", "test_cases/[0-9][0-9]*.xo*")
"""Its files, as patterns."""
DIGESTED = (RESULT, FAILURES, BLOCKS, FAULTS, FAULT_BLOCKS, EPISODES)
"""Files that hold numbers of a run; pictures follow from them."""
RESULT_FILES = (*DIGESTED, *PICTURES, STUDY, REPORT)
CRASH = tuple(
    "crash striking struck impact_speed closing_speed delta_v_striking delta_v_struck "
    "injury_risk_striking injury_risk_struck".split()
)
"""Columns of failures.csv that say what a failure ended in: `rare_envs.traffic.crash.Crash`."""
MOST_NAMED = 4
"""Files and folders that an error names."""
MAX_TABLE_RATIO = 50
"""Largest ratio of the bytes of columns to those of their file, in which parameters take as many as they have."""
MAX_TABLE_BYTES = 2**32
"""Largest table that is read at once [bytes]: 40 million simulations with twelve numbers each."""


def read_failures(folder: Path) -> dict[str, NDArray[Any]]:
    """Read the failures of a run, the most likely first.

    Args:
        folder: Of `rare-envs estimate --out`.

    Returns:
        Parameters by name, shape (n,), or (n, size) for blocks; then "f" and "log_p0", shape (n,), and what the
        failure ended in: "crash" (words) and the numbers of `CRASH`, NaN without a crash; and f with other drivers in
        the ego's place ("f_human", NaN if it did not drive). The parameters of row k
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
    text = read_text_file(path)
    if text.count(",") + text.count("\n") > MAX_VALUES:
        raise ValueError(f"it has more than {MAX_VALUES:,} cells")
    header, *rows = csv.reader(io.StringIO(text, newline="")) or [[]]
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
    members = read_members(path)
    try:
        found = {
            name.removesuffix(".npy"): np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
            for name, content in members.items()
        }
        if any(block.dtype.kind != "f" or block.ndim != 2 for block in found.values()):
            raise ValueError("a block is no table of numbers")
    except Exception as error:  # NumPy's headers have errors of their own
        raise ValueError(f"{str(path)!r} is damaged: {one_line(error)}.") from error
    return {name: block.astype(np.float64) for name, block in found.items()}


@dataclass(frozen=True)
class LoadedStudy:
    """A finished run; nothing of the ego or of its question is run, whoever wrote the folder."""

    folder: Path
    about: dict[str, Any]
    """What study.json holds: command, versions, ego, base, parameters; empty for runs of earlier versions."""
    result: dict[str, Any]
    """What result.json holds."""

    @property
    def question(self) -> dict[str, Any]:
        """The question as it was asked."""
        return dict(self.result.get("question") or {})

    @property
    def p(self) -> float:
        """Estimated probability."""
        return float(self.result["p"])

    @property
    def interval(self) -> tuple[float, float]:
        """Its interval, of the sampling error alone."""
        low, high = self.result["interval"]
        return float(low), float(high)

    @cached_property
    def failures(self) -> dict[str, NDArray[Any]]:
        """The most likely failures, see `read_failures`."""
        return read_failures(self.folder)

    @property
    def modes(self) -> list[int | None]:
        """Numbers of the most likely failure of each kind of crash, the most frequent first; None if none is listed."""
        found = self.result.get("modes")
        numbers = [each.get("failure") for each in found if isinstance(each, dict)] if isinstance(found, list) else []
        return [number if type(number) is int else None for number in numbers]

    @property
    def changed_files(self) -> list[str]:
        """Names of files that are not what the run wrote: damaged, edited, removed, or of another run."""
        written = self.about.get("results")
        if not isinstance(written, dict):
            return []
        found = {name: digest_file(self.folder / name) for name in DIGESTED if (self.folder / name).is_file()}
        return [name for name in DIGESTED if found.get(name) != written.get(name)]

    @property
    def episodes_path(self) -> Path:
        """File of all simulations, for programs that read Parquet by themselves."""
        return self.folder / EPISODES

    @property
    def column_names(self) -> list[str]:
        """Columns of the table of all simulations."""
        with open_parquet(self.episodes_path) as file:
            return list(file.schema_arrow.names)

    def episodes(self, columns: list[str] | None = None, failed: bool | None = None) -> pyarrow.Table:
        """Return the table of all simulations, a row each; docs/using_results.md has its columns.

        Reading takes about 1.5 times its memory: 1 GB for the 12 columns of 10^7 simulations of car-following.
        """
        import pyarrow.parquet as pq

        path = self.episodes_path
        if not path.is_file():
            raise FileNotFoundError(f"There is no {EPISODES} in {str(self.folder)!r}.")
        known = self.column_names
        missing = sorted(set(columns or []) - set(known))
        if missing:
            raise ValueError(f"{EPISODES} has no column {', '.join(missing)}; it has {', '.join(known)}.")
        where = None if failed is None else [("failed", "=", failed)]
        with open_parquet(path) as file:
            _check_size(path, file, columns or known)
            with open_ordinary(path) as opened:  # read ahead, it would take twice the memory
                return pq.read_table(opened, columns=columns, filters=where, pre_buffer=False)


def _check_size(path: Path, file: pyarrow.parquet.ParquetFile, columns: list[str]) -> None:
    """Raise a ValueError if some columns of a table would take more than `MAX_TABLE_BYTES`."""
    about, schema = file.metadata, file.schema_arrow
    n_rows = sum(about.row_group(i).num_rows for i in range(about.num_row_groups))
    n_bytes = 8 * n_rows * sum(int(getattr(schema.field(name).type, "list_size", 1)) for name in columns)
    if n_bytes > max(2**26, MAX_TABLE_RATIO * path.stat().st_size):
        raise ValueError(f"{EPISODES} is damaged: {n_rows:,} rows do not fit into it.")
    if n_bytes > MAX_TABLE_BYTES:
        raise ValueError(
            f"{len(columns)} columns of {EPISODES} take {n_bytes / 2**30:,.1f} GiB, more than the "
            f"{MAX_TABLE_BYTES / 2**30:g} GiB that are read at once: ask for fewer columns, or read {str(path)!r} in "
            "parts by a program of your own."
        )


def load_finished(folder: Path) -> LoadedStudy:
    """Return a finished run with its failures, or raise a BadInput: there is none, or its files are damaged."""
    if (folder / JOURNAL).exists():
        raise BadInput(
            f"The run in {str(folder)!r} is not finished: rare-envs resume {shlex.quote(str(folder))} comes first."
        )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        study = load_study(folder)
    with as_bad_input(OSError, ValueError):
        _ = study.failures  # read here: an error stands alone
    for each in told:
        warnings.warn(each.message, stacklevel=2)
    return study


def load_study(folder: str | Path) -> LoadedStudy:
    """Read the folder of a finished run.

    Args:
        folder: Of `rare-envs estimate --out`.

    Returns:
        Its numbers; failures and simulations are read when they are asked for. Files that are not what the run wrote
        come with a warning, and their names are its `changed_files`; so do files without digests.

    Raises:
        BadInput: There is no finished run, or a file of it is damaged.

    Example:
        >>> import rare_envs
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from rare_envs.study import Question, prepare, run_into
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", gamma=3.0, method="mc", max_sim=1000, seed=0)
        >>> with TemporaryDirectory() as folder:
        ...     report = run_into(Path(folder), prepare(question))
        ...     study = rare_envs.load_study(folder)
        >>> study.result["n_sim"], study.result["p"] == report.estimate.p
        (1000, True)
    """
    path = Path(folder)
    if not all((path / name).is_file() for name in (RESULT, FAILURES)):
        raise BadInput(
            f"No finished run in {str(folder)!r}: expected {RESULT} and {FAILURES}, as rare-envs estimate --out "
            f"writes, but {_say_what_is_there(path)}."
        )
    about = read_object(path / STUDY) if (path / STUDY).exists() else {}
    if about.get("format") != STUDY_FORMAT and (path / STUDY).exists():
        raise BadInput(
            f"Expected format {STUDY_FORMAT} in {str(path / STUDY)!r}, got {reprlib.repr(about.get('format'))}: "
            "the file is damaged, or of a newer version of rare-envs. Without it the run can be read."
        )
    result = read_object(path / RESULT)
    interval = result.get("interval")
    numbers = [result.get("p"), *(interval if isinstance(interval, list) and len(interval) == 2 else [None])]
    if not all(type(value) in (int, float) and 0.0 <= value < math.inf for value in numbers):
        raise BadInput(f"Expected p and its interval as numbers, 0 or more, in {str(path / RESULT)!r}.")
    study = LoadedStudy(path, about, result)
    with as_bad_input(OSError):
        changed = study.changed_files
    if changed:
        doubt = f"Not what the run in {str(folder)!r} wrote, by the digests in its {STUDY}: {', '.join(changed)}."
    elif not isinstance(about.get("results"), dict):
        doubt = (
            f"Nothing tells whether the files in {str(folder)!r} are what a run wrote: no {STUDY} with their digests."
        )
    else:
        return study
    warnings.warn(doubt, stacklevel=2)
    return study


def _say_what_is_there(path: Path) -> str:
    """Return what is in the place of a run, and which folder to give if there is one near."""
    if not path.is_dir():
        return "it is a file" if path.exists() else "there is no such folder"
    runs = [str(each.parent) for each in sorted(path.glob(f"*/{RESULT}"))]
    if (path.parent / RESULT).is_file():
        runs.append(str(path.parent))
    if runs:
        return f"there is one in {', '.join(runs[:MOST_NAMED])}: give that folder"
    if next(path.glob(f"*/{JOURNAL}"), None):
        return "the command that writes into it was stopped: give the same command again"
    names = sorted(each.name for each in path.iterdir())
    more = " and more" if len(names) > MOST_NAMED else ""
    return f"it has {', '.join(names[:MOST_NAMED])}{more}" if names else "it is empty"


def read_object(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file, or raise a BadInput."""
    with as_bad_input(OSError, ValueError):
        return read_json(path)
