"""Question as a folder records it: read from a file that anybody may have written, and asked for trust."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from agents.loading import find_ego_kind, strip_prefixes
from rare_envs.code_trust import check_code_trust, note_own_run
from rare_envs.study.analysis.moved_files import find_moved_files
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.study.question import Question, read_question

MAX_TEXT = 2**16
"""Letters of a name or formula in a question."""
_CHANGEABLE = ("trust", "on_error", "core", "device")
"""Fields that a resumed run may change, or that follow from what is installed."""
_ADDRESS = "ego"
"""Changes too where the ego is in another program."""


def open_question(recorded: object, folder: Path, trust: bool) -> Question:
    """Return the question of a folder, if its values are of the right types and what code it names may run.

    What simulates it (`core`) is chosen anew, on the CPU, and files that have moved with the folder are found.

    Args:
        recorded: Of the file.
        folder: Where it is, for messages.
        trust: Let the code that it names run, and the ego's file.

    Raises:
        BadInput: It is no question, or was not asked here and names code; nothing of that has been run then.
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
    """Return whether a recorded question is this one, but for what a run that is resumed may change.

    Args:
        recorded: Of a file.
        question: The question.
    """
    asked = _record(question)
    if find_ego_kind(question.ego) == "remote":
        del asked[_ADDRESS]
    return isinstance(recorded, Mapping) and all(recorded.get(name) == value for name, value in asked.items())


def list_code(question: Question) -> list[str]:
    """Return the code that a question names, as `module:name`."""
    ego, measure, env_id = strip_prefixes(question.ego), question.measure, question.env_id
    found = [ego] if find_ego_kind(ego) == "function" else []
    found += [measure] if ":" in measure and not measure.startswith("stl:") else []
    return found + ([env_id] if ":" in env_id else [])


def _record(question: Question) -> dict[str, Any]:
    return {name: value for name, value in asdict(question).items() if name not in _CHANGEABLE}
