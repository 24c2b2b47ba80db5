"""Writing of the folder of a run: journal and study.json at its beginning, results, tables and pictures at its end."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import itertools
import json
import platform
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import samplers
from agents.loading import find_ego_kind, strip_prefixes
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.files import digest_file, format_json, replace_file, replace_text
from rare_envs.startup import __version__
from rare_envs.study import run_folder
from rare_envs.study.arguments import (
    BadInput,
    Question,
    RunInterrupted,
    UnwrittenResults,
    as_bad_input,
    output_folder,
    read_question,
)
from rare_envs.study.episodes import MAX_SHOWN, list_columns
from rare_envs.study.plots import SEVERE, save_pictures, saved_figure
from rare_envs.study.question import (
    CHANGEABLE,
    Study,
    digest_files,
    find_changed_files,
    find_ego_files,
    is_same_question,
    note_question,
    read_about,
)
from rare_envs.study.report import Report
from rare_envs.study.text import report_as_json
from rare_envs.traffic.crash import CRASH_KINDS, NONE
from samplers.journal import Journal, JournalError, NothingRecorded
from samplers.result import method_settings

WHOLES = ("risk.json", "comparison.json", "estimate.safetensors")
"""Results of commands that are no single estimate."""
SUM = "compare sums"
"""Command of a comparison summed over scenarios: the folder of each has two journals, which stay to the end of all."""
BEGIN_AGAIN = "give the command again."
"""Advice if there is nothing to continue."""


def advise_resume(folder: Path, trust: bool = False) -> str:
    """Return the command that continues the run in a folder."""
    return f"rare-envs resume {shlex.quote(str(folder))}{' --trust' if trust else ''}"


def begin_journal(
    folder: Path, question: Question, force: bool = False, whole: Mapping[str, Any] | None = None
) -> Journal:
    """Return the journal of a new run; `force` replaces that of an unfinished one.

    A part of a command, whose name and arguments are `whole`, is continued.
    """
    if not force and not (folder / run_folder.JOURNAL).exists():
        check_no_results(folder)
    head: dict[str, Any] = {"version": __version__, "question": asdict(question), "files": digest_files(question)}
    head |= {"seed": question.seed, "whole": dict(whole or {})}
    try:
        return Journal.create(folder / run_folder.JOURNAL, head, replace=force)
    except JournalError as error:
        if "already" not in str(error):
            raise BadInput(error) from error
        if whole:
            return _continue_same(folder, head)
        raise BadInput(
            f"There is an unfinished run in {str(folder)!r}: continue it with {advise_resume(folder)}, or replace it "
            "by --force."
        ) from error
    except OSError as error:
        raise BadInput(f"Cannot write to the folder {str(folder)!r}: {error.strerror}.") from error


def _continue_same(folder: Path, head: dict[str, Any]) -> Journal:
    """Return the journal of an unfinished run of the question and files of a head, in the batches of its beginning."""
    journal, begun = continue_journal(folder)
    before, now = _flatten_head(journal.head, asdict(begun)), _flatten_head(json.loads(json.dumps(head)))
    other = [name for name in dict.fromkeys((*now, *before)) if before.get(name) != now.get(name)]
    other += find_changed_files(journal.head.get("files") or {}, head["files"])
    if not other:
        note_on_error(journal, head["question"]["on_error"])
        return journal
    journal.close()
    raise BadInput(f"The run in {str(folder)!r} was begun with another {', '.join(other)}: replace it by --force.")


def note_on_error(journal: Journal, on_error: str) -> None:
    """Note in a journal how faults count from now on, so that a later resumption counts them so too."""
    asked = journal.head["question"]
    if asked.get("on_error") != on_error:
        with as_bad_input(OSError):
            journal.amend({**journal.head, "question": {**asked, "on_error": on_error}})


def _flatten_head(head: Mapping[str, Any], question: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the question and command of a head, without what a run that is continued may change, batches included."""
    whole = dict(head.get("whole") or {})
    every = {**whole, **dict(whole.get("options") or {}), **(question or head["question"])}
    return {name: value for name, value in every.items() if name not in ("options", "chunk", "chunked", *CHANGEABLE)}


def find_whole(folder: Path, mend: bool = False) -> tuple[Path, dict[str, Any], dict[str, Question]]:
    """Return the folder of an unfinished run, its command with arguments, and the questions of the parts begun.

    The command is empty for a single estimate; a folder of a part of a comparison means that of the comparison. Parts
    are named by their folders in it, those of a comparison summed over scenarios by their whole paths.
    """
    name = run_folder.JOURNAL
    sums, own, parts = sorted(folder.glob(f"*/*/{name}")), [folder / name], sorted(folder.glob(f"*/{name}"))
    paths = sums or (own if own[0].exists() or not parts else parts)
    wholes, questions = list[dict[str, Any]](), dict[str, Question]()
    for path in paths:
        part = path.parent
        journal, question = continue_journal(part, mend)
        questions[str(part) if sums else "" if paths is own else part.name] = question
        wholes.append(dict(journal.head.get("whole") or {}))
        journal.close()
    whole, command = wholes[0], wholes[0].get("command")
    if not sums and (command == SUM or (paths is own and command == "compare")):
        return find_whole(folder.parent, mend)
    if paths is own:
        return folder, whole if command == "estimate" else {}, questions
    if not whole or any(each != whole for each in wholes) or (sums and command != SUM):
        again = advise_resume(paths[0].parent.parent if sums else paths[0].parent)
        raise BadInput(f"{str(folder)!r} has several runs: continue each, such as {again}.")
    return folder, whole, questions


def continue_journal(folder: Path, mend: bool = False) -> tuple[Journal, Question]:
    """Return the journal of an unfinished run, and its question; of a damaged one `mend` keeps what is before that."""
    path, begun = folder / run_folder.JOURNAL, "stopped before its first simulations"
    try:
        journal = Journal.open(path, mend)
    except FileNotFoundError as error:
        there = f"it has no {run_folder.JOURNAL}" if folder.is_dir() else "the folder does not exist"
        why = f"{there}. If the run was {begun}, {BEGIN_AGAIN}"
        if done := next((name for name in (run_folder.RESULT, *WHOLES) if (folder / name).is_file()), ""):
            why = f"it has a finished one ({done})."
        raise BadInput(f"There is no unfinished run in {str(folder)!r}: {why}") from error
    except NothingRecorded as error:
        raise BadInput(f"The run in {str(folder)!r} was {begun}: {BEGIN_AGAIN}") from error
    except OSError as error:
        raise BadInput(f"Cannot resume {str(path)!r}: {error.strerror}.") from error
    except JournalError as error:
        advice = ""
        if "damaged from its first record on" in str(error):
            advice = " Nothing can be taken from it: it is left as it is, and the command with --force replaces it."
        elif "damaged" in str(error):
            advice = f" To keep what is before the damage: {advise_resume(folder)} --mend."
        raise BadInput(f"{error}{advice}") from error
    version = journal.head.get("version")
    try:
        if version != __version__:
            raise BadInput(f"it was begun by version {version}, this is {__version__}.")
        return journal, read_question(journal.head.get("question"))
    except BadInput as error:
        journal.close()
        raise BadInput(f"Cannot resume {str(path)!r}: {error}") from error


@contextlib.contextmanager
def journals_of(
    whole: Mapping[str, Any], out: Path | None, questions: Mapping[str, Question], force: bool, *results: str
) -> Iterator[Sequence[Journal | None]]:
    """Yield the journals of the parts of a command, each in a folder in `out`; what stops it says what they keep.

    `whole` has the name of the command and its arguments. If it begins by `force`, the parts and the results of an
    earlier one are removed. None without `out`.
    """
    with contextlib.ExitStack() as stack:
        if out is None:
            yield [None for _ in questions]
            return
        of_sum, journals = whole["command"] == SUM, list[Journal]()
        whole_folder = output_folder(out, *results, folders=questions)
        stack.enter_context(whole_folder if of_sum else folder_of_parts(out, questions, (), force, *results))
        for name, question in questions.items():
            journal = begin_journal(out / name, question, whole=whole)
            journals.append(stack.enter_context(contextlib.closing(journal)))
            note_question(question)
        try:
            yield journals
        except (BadInput, KeyboardInterrupt) as error:
            if not (kept := sum(journal.flush() for journal in journals)):
                for journal in journals:
                    journal.remove()
                raise
            trust = any(question.trust for question in questions.values())
            resumed = advise_resume(out.parent if of_sum else out, trust)
            again = f"{error} {kept:,} simulations are kept; go on with: {resumed}"
            kind = RunInterrupted if isinstance(error, KeyboardInterrupt) else UnwrittenResults
            raise kind(again, getattr(error, "report", None)) from error


@contextlib.contextmanager
def folder_of_parts(
    folder: Path | None, parts: Mapping[str, Question], asked: Sequence[Question], force: bool, *results: str
) -> Iterator[None]:
    """Make the folder of a command, in which parts that were begun go on; their journals end with it.

    Parts are named by their paths in it. What was asked is noted, unless it needed trust, and needs it again. `force`
    removes earlier results; without it the first of them is refused.
    """
    if folder is None:
        yield
        return
    for question in asked if not any(each.trust for each in parts.values()) else ():
        note_question(question)
    paths = {folder / name: question for name, question in parts.items()}
    owners = {folder / name.partition("/")[0]: name.partition("/")[0] for name in parts}
    with output_folder(folder, *results, folders=filter(None, owners.values())):
        if force:
            clear_runs(paths)
            for owner, name in itertools.product((folder, *owners), results):
                (owner / name).unlink(missing_ok=True)
        else:  # all of them, before the first one is run
            check_no_results(folder, results[0])
        for owner in owners:
            if not any((path / run_folder.JOURNAL).exists() for path in paths if path.is_relative_to(owner)):
                check_no_results(owner, results[0])
        yield
        for path in paths:
            (path / run_folder.JOURNAL).unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # it has results
                path.rmdir()


def clear_runs(parts: Mapping[Path, Question]) -> None:
    """Remove earlier runs from the folders of parts of a command, so that the new ones can be stopped and go on."""
    for folder, question in parts.items():
        if (folder / run_folder.JOURNAL).exists():
            begin_journal(folder, question, force=True).remove()
        _remove_results(folder)


def check_no_results(folder: Path, *names: str) -> None:
    """Raise a BadInput if a folder has results of a finished run, or files of these names."""
    for name in (run_folder.RESULT, run_folder.FAILURES, *names):
        if (folder / name).exists():
            raise BadInput(f"There is a finished run in {str(folder)!r} ({name}): replace it by --force.")


def _remove_results(folder: Path) -> None:
    """Remove the results of an earlier run, and the drafts of one that was killed while it wrote."""
    for name in run_folder.RESULT_FILES:
        (folder / name).unlink(missing_ok=True)
    remove_evidence(folder)
    _remove_drafts(folder)


def remove_evidence(folder: Path) -> None:
    """Remove the files of evidence of an earlier run, or of an earlier call."""
    for pattern in run_folder.EVIDENCE_FILES:
        for path in (folder / run_folder.EVIDENCE).glob(pattern):
            path.unlink()


def _remove_drafts(folder: Path) -> None:
    """Remove drafts of results, see `rare_envs.files.replace_file`."""
    for name in map(Path, run_folder.RESULT_FILES):
        for draft in folder.glob(f".{name.stem}.*.part{name.suffix}"):
            with contextlib.suppress(OSError):  # a folder of that name is none
                draft.unlink()


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
    space, faults, kinds = report.study.problem.space, report.faults, report.kinds
    replace_text(folder / run_folder.RESULT, format_json(report_as_json(report)) + "\n")
    nobody = ("" if kinds.unknown else CRASH_KINDS[NONE], *("" for _ in run_folder.CRASH[1:]))
    crashes = [
        (
            *(each["kind"], *each["vehicles"], each["impact_speed"], each["closing_speed"]),
            *(*each["delta_v"], *each["injury_risk"]),
        )
        if each is not None
        else nobody
        for each in report.crashes
    ]
    write_failures(folder, space, report.estimate.failures, crashes, kinds.others_listed)
    for name in (run_folder.FAULTS, run_folder.FAULT_BLOCKS, *run_folder.PICTURES):
        (folder / name).unlink(missing_ok=True)
    if faults:
        x = np.stack([fault.x for fault in faults])
        _write_table(folder / run_folder.FAULTS, space, x, ("reason",), [(fault.reason,) for fault in faults])
    save_pictures(folder, report)
    if isinstance(report.sensitivity, samplers.analysis.Sensitivity):
        with saved_figure(folder / run_folder.SENSITIVITY, 3.6) as figure:
            report.sensitivity.plot(figure.subplots())
    if kinds.severity is not None and kinds.severity.largest_delta_v > SEVERE:
        with saved_figure(folder / run_folder.SEVERITY, 3.6) as figure:
            kinds.severity.plot(figure.subplots())


def write_failures(
    folder: Path,
    space: ScenarioSpace,
    failures: samplers.Failures,
    crashes: Sequence[tuple[Any, ...]] = (),
    others: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
) -> None:
    """Write `FAILURES`: one failure a row, the most likely first: x, f, log p0, and the columns `CRASH` if known.

    Then f with other drivers in the ego's place, as "f_human"; the cell is empty if it did not drive.
    """
    f_others = [["" if np.isnan(f) else f for f in each.tolist()] for each in others.values()]
    beside = list(zip(*f_others, strict=True)) or [()] * len(failures)
    parts = zip(failures, crashes or [()] * len(failures), beside, strict=True)
    rows = [(one.f, one.log_p0, *crash, *f) for one, crash, f in parts]
    names = ("f", "log_p0", *(run_folder.CRASH if crashes else ()), *(f"f_{name}" for name in others))
    _write_table(folder / run_folder.FAILURES, space, failures.x, names, rows)


def _write_table(
    path: Path, space: ScenarioSpace, x: NDArray[np.float64], names: Sequence[str], rest: list[tuple[Any, ...]]
) -> None:
    """Write scenarios x (n, d), one per row.

    The table has the columns of x by name but for large blocks, then the rest. Large blocks go row by row into a file
    of arrays beside it, in single precision, in which they are simulated, so that they replay to the same f; so do
    numbers of the table, as repr of a float gives it back exactly.
    """
    columns = list_columns(space)
    shown = [column.shown for column in columns]
    with replace_file(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*(column.name for column in columns if column.shown), *names])
        writer.writerows([*row[shown].tolist(), *more] for row, more in zip(x, rest, strict=True))
    parts = zip(space.columns(x).items(), space.sizes, strict=True)
    blocks = {name: part.astype(np.float32) for (name, part), size in parts if size > MAX_SHOWN}
    blocks_path = path.with_suffix(".npz")
    blocks_path.unlink(missing_ok=True)
    if blocks:
        with replace_file(blocks_path) as draft:
            # allow_pickle=False, as its types would like, is a block to NumPy 2.0
            np.savez_compressed(draft, **blocks)  # type: ignore[arg-type]


LIBRARIES = "cvxpy gymnasium highway-env numba numpy onnxruntime scikit-learn scipy stable-baselines3 torch".split()
"""Distributions whose versions may change a number."""


def begin_study_file(folder: Path, study: Study, scenarios: Sequence[str] | None = None) -> None:
    """Write study.json of a run that begins, in place of the files of an earlier one, and note that it was asked.

    Of a part of a sum it has the scenarios of all, as they were asked for.
    """
    _remove_results(folder)
    _write_study_file(folder, describe_study(study) | ({"scenarios": [*scenarios]} if scenarios else {}))
    note_question(study.question)


def note_resumption(folder: Path, earlier_seconds: float) -> None:
    """Note in study.json that an interrupted run of so many seconds goes on; one that cannot be read is left."""
    _remove_drafts(folder)
    if "question" in (about := read_about(folder)):
        with contextlib.suppress(OSError):  # a full disk is found when results are written
            _write_study_file(folder, about | {"resumed": _now(), "earlier_seconds": earlier_seconds})


def finish_run(folder: Path, report: Report) -> None:
    """Write the results, and note in study.json that the run is done; a folder that somebody removed is made again."""
    with unwritten_results(folder, report):
        folder.mkdir(parents=True, exist_ok=True)
        write_run(folder, report)
        begun = read_about(folder)  # stays, but for what somebody has put there: of another question, or of none
        if not is_same_question(begun.get("question"), report.study.question):
            begun = describe_study(report.study)
        digests = {name: digest_file(folder / name) for name in run_folder.DIGESTED if (folder / name).is_file()}
        ended = {"finished": _now(), "seconds": report.seconds, "results": digests}
        _write_study_file(folder, {**begun, **ended})


@contextlib.contextmanager
def unwritten_results(folder: Path, report: Any) -> Iterator[None]:
    """Raise an OSError as UnwrittenResults, with the answer."""
    try:
        yield
    except OSError as error:
        raise UnwrittenResults(
            f"Cannot write the results to {str(folder)!r}: {error.strerror or error}.", report
        ) from error


def describe_study(study: Study) -> dict[str, Any]:
    """Return what study.json holds at the beginning of a run."""
    question, space, base = study.question, study.problem.space, study.fitted
    fit = {} if base is None else {"fitted_to": base.fitted_to, "family": base.family}
    ego_files = {str(path): digest_file(path) for path in find_ego_files(question)}
    rests_on = "".join(sorted(ego_files.values())) or f"{question.ego} of rare-envs {__version__}"
    versions = {"rare-envs": __version__, "python": platform.python_version()}
    for name in LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    program = Path(sys.argv[0] if sys.argv else "")
    ours = program.stem == "rare-envs" or program.parts[-2:] == ("rare_envs", "__main__.py")
    columns = zip(space.names, space.units, space.sizes, strict=True)
    return {
        "format": run_folder.STUDY_FORMAT,
        "command": shlex.join(["rare-envs", *sys.argv[1:]]) if ours else "",
        "begun": _now(),
        "finished": None,
        "seconds": None,
        "seed": question.seed,
        "gamma": question.gamma,
        "ego": {
            "name": question.ego,
            "kind": find_ego_kind(strip_prefixes(question.ego)),
            "files": ego_files,
            "fingerprint": hashlib.blake2b(rests_on.encode(), digest_size=16).hexdigest(),
        },
        "base": {"name": study.base_name, "fitted_to": "", "family": "", **fit},
        "method": {"name": study.method.name, "settings": method_settings(study.method)},
        "parameters": [{"name": name, "unit": unit, "size": int(size)} for name, unit, size in columns],
        "question": asdict(question),
        "files": digest_files(question),
        "versions": versions,
        "platform": platform.platform(),
    }


def _write_study_file(folder: Path, about: dict[str, Any]) -> None:
    replace_text(folder / run_folder.STUDY, format_json(about) + "\n")


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
