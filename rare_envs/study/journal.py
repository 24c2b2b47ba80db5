"""Journal: the finished simulations of a run, so that one that was interrupted can be continued.

The journal lies in the run's folder until the run is done; `samplers.journal` has its form and its promises.
Here it gets the question of the run, digests of the files that the question names, and what is known of faults.
"""

from __future__ import annotations

import hashlib
import importlib.util
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from agents.loading import find_ego_kind, strip_prefixes
from agents.saved_ego import HUB_PREFIX, find_cached_model, find_statistics
from rare_envs.study.arguments import Question, read_question
from rare_envs.study.errors import BadInput
from rare_envs.study.run_folder import RESULT
from rare_envs.version import __version__
from samplers.journal import Journal, JournalError, NothingRecorded

JOURNAL = "journal.bin"
"""Name of the file in the folder of a run."""
BEGIN_AGAIN = "give the command again."
"""Advice where there is nothing to continue."""


def begin_journal(folder: Path, question: Question, force: bool = False) -> Journal:
    """Return the journal of a new run.

    Args:
        folder: Of the run.
        question: What it is about.
        force: Replace the journal of an unfinished run.

    Raises:
        BadInput: There is an unfinished run, somebody else is writing it, or nothing can be written.
    """
    path = folder / JOURNAL
    head = {"version": __version__, "question": asdict(question), "files": digest_files(question)}
    try:
        return Journal.create(path, head, replace=force)
    except JournalError as error:
        if "already" not in str(error):
            raise BadInput(error) from error
        raise BadInput(
            f"There is an unfinished run in {str(folder)!r}: continue it with rare-envs resume "
            f"{shlex.quote(str(folder))}, or replace it by --force."
        ) from error
    except OSError as error:
        raise BadInput(f"Cannot write to the folder {str(folder)!r}: {error.strerror}.") from error


def refuse_unfinished(folder: Path) -> None:
    """Raise a BadInput if a folder has a run that is not finished."""
    if (folder / JOURNAL).exists():
        raise BadInput(
            f"The run in {str(folder)!r} is not finished: rare-envs resume {shlex.quote(str(folder))} comes first."
        )


def continue_journal(folder: Path, mend: bool = False) -> tuple[Journal, Question]:
    """Return the journal of an unfinished run, and its question.

    Args:
        folder: Of the run.
        mend: Of a damaged journal, keep what stands before the damage.

    Raises:
        BadInput: There is none to continue, or one of another version of this program; it is damaged, or in use.
    """
    path = folder / JOURNAL
    try:
        journal = Journal.open(path, mend)
    except FileNotFoundError as error:
        raise BadInput(f"There is no unfinished run in {str(folder)!r}: {_explain_no_journal(folder)}") from error
    except NothingRecorded as error:
        raise BadInput(f"The run in {str(folder)!r} was stopped before its first simulations: {BEGIN_AGAIN}") from error
    except OSError as error:
        raise BadInput(f"Cannot take up {str(path)!r}: {error.strerror}.") from error
    except JournalError as error:
        raise BadInput(f"{error}{_advise_on_damage(str(error), folder)}") from error
    try:
        return journal, _read_question(journal)
    except BadInput as error:
        journal.close()
        raise BadInput(f"Cannot take up {str(path)!r}: {error}") from error


def _advise_on_damage(error: str, folder: Path) -> str:
    """Return what to do about a damaged journal, behind a space; empty where the error is another one."""
    if "damaged from its first record on" in error:
        return " Nothing can be taken from it: it is left as it is, and the command with --force replaces it."
    if "damaged" in error:
        return f" What stands before the damage is kept by rare-envs resume {shlex.quote(str(folder))} --mend."
    return ""


def _explain_no_journal(folder: Path) -> str:
    """Return why a folder has no journal, and what to do."""
    if (folder / RESULT).is_file():
        return f"it has a finished one ({RESULT})."
    if not folder.is_dir():
        return f"the folder does not exist. Of a run that was stopped before its first simulations, {BEGIN_AGAIN}"
    return f"it has no {JOURNAL}. Of one that was stopped before its first simulations, {BEGIN_AGAIN}"


def _read_question(journal: Journal) -> Question:
    version = journal.head.get("version")
    if version != __version__:
        raise BadInput(f"it was begun by version {version}, this is {__version__}.")
    return read_question(journal.head.get("question"))


def check_same_files(journal: Journal, question: Question) -> None:
    """Raise a BadInput if a file that the question names has changed since the run was begun, wherever it lies now."""
    changed = find_changed_files(journal.head.get("files") or {}, digest_files(question))
    if changed:
        raise BadInput(
            f"{', '.join(changed)} has changed since the run in {str(journal.path.parent)!r} was begun, and its "
            "simulations are of what it was before. Begin anew with --force."
        )


def find_changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the files of other content, those that are gone and those that are new; where a file lies does not matter.

    Args:
        before: Digests by path, of when a run was begun.
        now: The same of this moment.

    Example:
        >>> find_changed_files({"a.zip": "1"}, {"moved/a.zip": "1"}), find_changed_files({"a.zip": "1"}, {"a.zip": "2"})
        ([], ['a.zip'])
    """
    gone = {name for name, digest in before.items() if digest not in now.values()}
    new = {name for name, digest in now.items() if digest not in before.values()}
    return sorted(gone | new)


def digest_files(question: Question) -> dict[str, str]:
    """Return the BLAKE2b digests of the files of a question, by path; modules are found, not imported.

    They are those that it names, and the `VecNormalize` statistics that are read with its ego.

    Example:
        >>> digest_files(Question(env_id="rare_envs/CutIn-v0"))
        {}
    """
    bases = [name.strip() for name in (question.also_under or "").split(",")]
    names = [question.base, question.drivers, question.measure, *bases]
    paths = {path for name in names if name for path in find_named_files(name)}
    return digest_contents(sorted(paths | set(find_ego_files(question))))


def digest_contents(paths: Sequence[Path]) -> dict[str, str]:
    """Return the BLAKE2b digests of files, by path."""
    return {str(path): hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() for path in paths}


def find_ego_files(question: Question) -> list[Path]:
    """Return the files of the ego of a question, the `VecNormalize` statistics that it is loaded with included."""
    spec = strip_prefixes(question.ego)
    files = find_named_files(spec)
    if find_ego_kind(spec) not in ("zip", "hub"):
        return files
    found = [Path(question.stats)] if question.stats else [find_statistics(path) for path in files]
    return [*files, *(path for path in found if path is not None and path.is_file())]


def find_named_files(name: str) -> list[Path]:
    """Return the file that an option names, or that of its module: a.zip, noisy:a.zip, hf:user/a, module:function."""
    if name.startswith(HUB_PREFIX):
        cached = find_cached_model(name)
        return [] if cached is None else [cached]
    parts = name.split(":")
    modules = [Path(f"{part.replace('.', '/')}{end}") for part in parts[:-1] for end in (".py", "/__init__.py")]
    try:
        files = [path for path in (Path(name), *map(Path, parts), *modules) if path.is_file()]
    except (OSError, ValueError):  # too long a name, or with a null byte
        return []
    found = [] if files else [origin for part in parts[:-1] if (origin := _find_module(part)) is not None]
    return files or [path for path in map(Path, found) if path.is_file()]


def _find_module(name: str) -> str | None:
    """Return the file of a module; not of one in a package, since looking for it would import the package."""
    if not name.isidentifier():
        return None
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    return None if spec is None else spec.origin
