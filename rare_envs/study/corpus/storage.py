"""Storage of a corpus: a folder with a file for each failure, named by the content of the scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.files import read_text_file, replace_text
from rare_envs.json_text import parse_json_object
from rare_envs.study.analysis.recorded_question import note_question, open_question
from rare_envs.study.corpus.stored_failure import StoredFailure, make_stored, read_stored
from rare_envs.study.errors import BadInput, as_bad_input, output_folder
from rare_envs.study.journal import refuse_unfinished
from rare_envs.study.question import read_question
from rare_envs.study.storage.failure_table import CRASH, read_failures
from rare_envs.study.storage.names import FAILURES, RESULT

MAX_CORPUS_FILES = 100_000
"""Files of a corpus that are read at most."""


def read_run(folder: Path, trust: bool = False) -> list[StoredFailure]:
    """Return the failures of a run, the most likely first; nothing is simulated and no ego is loaded.

    Args:
        folder: Of `rare-envs estimate --out`.
        trust: Trust the code that a run from elsewhere names.

    Raises:
        BadInput: There is no such run, it is not finished, its files are damaged, or it is not trusted.

    Example:
        >>> read_run(Path("runs/nowhere"))
        Traceback (most recent call last):
            ...
        rare_envs.study.errors.BadInput: No run in 'runs/nowhere': expected result.json and failures.csv, as rare-envs estimate --out writes.
    """  # noqa: E501 (the example shows a whole message)
    question = open_question(read_recorded(folder).get("question"), folder, trust)
    try:
        table = read_failures(folder)
    except OSError as error:
        raise BadInput(_no_run(folder)) from error
    except ValueError as error:
        raise BadInput(error) from error
    names = [name for name in table if name not in ("f", "log_p0", *CRASH)]
    if not names or not all(np.isfinite(table[name]).all() for name in names):
        raise BadInput(f"The files of failures in {str(folder)!r} are damaged: a parameter is no number.")
    words = table.get(CRASH[0])
    return [
        make_stored(
            question,
            {name: table[name][k] for name in names},
            float(table["f"][k]),
            float(table["log_p0"][k]),
            "" if words is None else str(words[k]),
        )
        for k in range(len(table["f"]))
    ]


def read_recorded(folder: Path) -> dict[str, Any]:
    """Return what the file `RESULT` of a finished run has.

    Raises:
        BadInput: There is no such run, or it is not finished.
    """
    refuse_unfinished(folder)
    try:
        return parse_json_object(read_text_file(folder / RESULT), repr(str(folder / RESULT)))
    except OSError as error:
        raise BadInput(_no_run(folder)) from error
    except ValueError as error:
        raise BadInput(error) from error


def _no_run(folder: Path) -> str:
    return f"No run in {str(folder)!r}: expected {RESULT} and {FAILURES}, as rare-envs estimate --out writes."


def choose_likely(failures: Sequence[StoredFailure], most: int, modes: Sequence[int] = ()) -> list[StoredFailure]:
    """Return the `most` most likely failures, one of each kind of crash and mode among them as far as there is room.

    Args:
        failures: The most likely first.
        most: Their number.
        modes: Numbers of the failures that stand for a mode each.
    """
    first: dict[str, int] = {}
    for number, failure in enumerate(failures):
        first.setdefault(failure.crash, number)
    order = list(dict.fromkeys([*first.values(), *modes, *range(len(failures))]))
    return [failures[number] for number in sorted(order[:most])]


def add_run(run: Path, corpus: Path, most: int = 20, trust: bool = False) -> tuple[list[StoredFailure], int]:
    """Add failures of a run to a corpus; those that it has already stay as they are.

    Args:
        run: Folder of `rare-envs estimate --out`.
        corpus: Folder of the corpus; is made, if need be.
        most: Number of failures, the most likely ones and one of each kind of crash and each mode.
        trust: Trust the code that a run from elsewhere names.

    Returns:
        The failures, and how many of them are new.

    Raises:
        BadInput: There is no such run, or the corpus cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from rare_envs.study import Question, prepare, run_into
        >>> question = Question(
        ...     env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=1000
        ... )
        >>> with TemporaryDirectory() as folder:
        ...     report = run_into(Path(folder) / "run", prepare(question))
        ...     chosen, new = add_run(Path(folder) / "run", Path(folder) / "corpus", most=5)
        ...     len(chosen), new, len(read_corpus(Path(folder) / "corpus"))
        (5, 5, 5)
    """
    if most < 1:
        raise BadInput(f"Expected at least one failure to add, got {most}.")
    failures = read_run(run, trust)
    chosen = choose_likely(failures, most, _find_modes(read_recorded(run), len(failures)))
    if not chosen:
        raise BadInput(f"The run in {str(run)!r} has no failure.")
    new = 0
    with output_folder(corpus), as_bad_input(OSError):
        for failure in chosen:
            path = corpus / f"{failure.key}.json"
            if not path.exists():
                replace_text(path, failure.to_json())
                new += 1
            note_question(read_question(failure.question_values()))
    return chosen, new


def _find_modes(recorded: Mapping[str, Any], n: int) -> list[int]:
    """Return the numbers of the failures, below n, that stand for a mode each; what is no number is left out."""
    modes = recorded.get("modes")
    numbers = [mode.get("failure") for mode in modes if isinstance(mode, dict)] if isinstance(modes, list) else []
    return [number for number in numbers if type(number) is int and 0 <= number < n]


def read_corpus(folder: Path) -> list[StoredFailure]:
    """Read a corpus, in the order of its files' names.

    Raises:
        BadInput: There is none, or one of its files is damaged.

    Example:
        >>> read_corpus(Path("nowhere"))
        Traceback (most recent call last):
            ...
        rare_envs.study.errors.BadInput: There is no corpus in 'nowhere': rare-envs corpus add RUN makes one.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise BadInput(f"There is no corpus in {str(folder)!r}: rare-envs corpus add RUN makes one.")
    if len(paths) > MAX_CORPUS_FILES:
        raise BadInput(f"The corpus in {str(folder)!r} has more than {MAX_CORPUS_FILES:,} files.")
    with as_bad_input(ValueError, OSError):
        return [read_stored(path) for path in paths]


def join_x(failures: Sequence[StoredFailure], names: Sequence[str], sizes: Sequence[int]) -> NDArray[np.float64]:
    """Return x (n, d) of failures for a problem with these parameters.

    An ego's own noise, `ego_noise`, belongs to the ego that failed: another one has zeros, its mean actions.

    Raises:
        ValueError: A failure lacks a parameter, or has another size of it.
    """
    rows = []
    for failure in failures:
        parts: list[Any] = []
        for name, size in zip(names, sizes, strict=True):
            part = failure.x.get(name)
            if name == "ego_noise" and (part is None or len(part) != size):
                part = [0.0] * size
            if part is None or len(part) != size:
                raise ValueError(
                    f"Stored failure {failure.key} has {0 if part is None else len(part)} values of {name}, its "
                    f"scenario has {size}: {failure.env_id} or its drivers have changed since."
                )
            parts += part
        rows.append(parts)
    return np.array(rows, dtype=np.float64)
