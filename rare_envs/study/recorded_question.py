"""Question as a folder records it: read from a file that anybody may have written, and asked for trust.

Files that the question names are found again where the folder has moved together with them.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from agents.loading import find_ego_kind, strip_prefixes
from rare_envs.code_trust import check_code_trust, note_own_run
from rare_envs.files import parse_json_object, read_text_file
from rare_envs.study.arguments import Question, read_question
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.study.journal import digest_contents, digest_files, find_changed_files, refuse_unfinished
from rare_envs.study.run_folder import STUDY, LoadedStudy, load_study

_FIELDS = ("ego", "stats", "base", "drivers", "measure", "also_under")
"""Fields of a question that can name files."""


def describe_places(files: Iterable[str], folder: Path) -> dict[str, str]:
    """Return where files lie as seen from the folder of a run, by their paths."""
    places = {}
    for name in files:
        try:
            places[name] = Path(os.path.relpath(name, folder)).as_posix()
        except ValueError:  # another drive of Windows
            continue
    return places


def find_moved_files(question: Question, folder: Path) -> Question:
    """Return the question of a run with files that are not where they were in the places that they have now.

    A file is looked for where it lay as seen from the folder of the run; its content must be what it was.
    """
    about = _read_about(folder)
    before, places = (_texts(about.get(name)) for name in ("files", "file_places"))
    with as_bad_input(OSError, ValueError):  # names of somebody else's making
        moved = dict(_list_moved(before, places, folder))
    renamed: dict[str, Any] = {name: _rename(getattr(question, name), moved) for name in _FIELDS}  # fields by name
    return replace(question, **renamed)


def warn_of_changed_files(question: Question, folder: Path) -> None:
    """Warn where a file of a run, or the statistics beside its ego, are not what they were when it was begun."""
    about = _read_about(folder)
    changed = find_changed_files(_texts(about["files"]), digest_files(question)) if "files" in about else []
    if changed:
        warnings.warn(
            f"{', '.join(changed)} changed since the run in {str(folder)!r} was begun, whose numbers are of what it "
            "was before.",
            stacklevel=2,
        )


def _list_moved(before: Mapping[str, str], places: Mapping[str, str], folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the files that have moved, each with its new path."""
    for name in sorted(before.keys() & places.keys()):
        path = folder / places[name]
        if _digest(Path(name)) == before[name] or not path.is_file():
            continue
        if _digest(path) == before[name]:
            yield name, str(path)
        elif not Path(name).is_file():
            raise BadInput(
                f"{str(path)!r} has changed since the run in {str(folder)!r} was begun, which names it as {name!r}: "
                "put the earlier file there, or begin anew."
            )


def _digest(path: Path) -> str | None:
    """Return the digest of a file; None where there is none."""
    return digest_contents([path])[str(path)] if path.is_file() else None


def _rename(value: str | None, moved: Mapping[str, str]) -> str | None:
    """Return what a field names, such as noisy:a.zip?delay=1, with the new paths of files."""
    for name, now in moved.items() if value is not None else ():
        whole = rf"(?:^|(?<=[:,\s])){re.escape(name)}(?=$|[?:,\s])"
        value = now.join(re.split(whole, str(value)))
    return value


def _read_about(folder: Path) -> dict[str, Any]:
    """Return what study.json holds; nothing where it cannot be read, which others tell."""
    try:
        return parse_json_object(read_text_file(folder / STUDY), STUDY)
    except (OSError, ValueError):
        return {}


def _texts(value: object) -> dict[str, str]:
    """Return the entries of an object that are texts."""
    found = value.items() if isinstance(value, dict) else ()
    return {str(name): text for name, text in found if isinstance(text, str)}


MAX_TEXT = 2**16
"""Letters of a name or formula in a question."""
_CHANGEABLE = ("trust", "on_error", "core", "device")
"""Fields that a resumed run may change, or that follow from what is installed."""


def load_finished(folder: Path) -> LoadedStudy:
    """Return a finished run with its failures.

    Raises:
        BadInput: There is none, it is not finished, or its files are damaged.
    """
    refuse_unfinished(folder)
    study = load_study(folder)
    with as_bad_input(OSError, ValueError):
        _ = study.failures  # read now
    return study


def open_run(study: LoadedStudy, trust: bool) -> Question:
    """Return the question of a finished run, see `open_question`."""
    return open_question(study.result.get("question"), study.folder, trust)


def open_question(recorded: object, folder: Path, trust: bool) -> Question:
    """Return the question of a folder, if its values are of the right types and what code it names may run.

    What simulates it (`core`) is chosen anew, on the CPU, and files that have moved with the folder are found.
    """
    question = replace(read_question(recorded), trust=trust, core="auto", device="cpu")
    if any(isinstance(value, str) and len(value) > MAX_TEXT for value in asdict(question).values()):
        raise BadInput(f"The question of the run in {str(folder)!r} has a name of more than {MAX_TEXT} letters.")
    with as_bad_input(ValueError):
        check_code_trust(_record(question), list_code(question), folder, trust)
    return find_moved_files(question, folder)


def note_question(question: Question) -> None:
    """Note that a question was asked here, so that its folder needs no trust."""
    note_own_run(_record(question), list_code(question))


def is_same_question(recorded: object, question: Question) -> bool:
    """Return whether a recorded question is this one, but for what a run that is resumed may change."""
    asked = _record(question)
    if find_ego_kind(question.ego) == "remote":
        del asked["ego"]  # its address may change
    return isinstance(recorded, Mapping) and all(recorded.get(name) == value for name, value in asked.items())


def list_code(question: Question) -> list[str]:
    """Return the code that a question names, as `module:name`."""
    ego, measure, env_id = strip_prefixes(question.ego), question.measure, question.env_id
    found = [ego] if find_ego_kind(ego) == "function" else []
    found += [measure] if ":" in measure and not measure.startswith("stl:") else []
    return found + ([env_id] if ":" in env_id else [])


def _record(question: Question) -> dict[str, Any]:
    return {name: value for name, value in asdict(question).items() if name not in _CHANGEABLE}
