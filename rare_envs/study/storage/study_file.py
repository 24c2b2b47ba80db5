"""study.json: what a run asks, of which ego, by what command, and with which versions of what it rests on."""

from __future__ import annotations

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

from agents.loading import find_ego_kind, strip_prefixes
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.files import read_text_file, replace_text
from rare_envs.json_text import format_json, parse_json_object
from rare_envs.study.analysis.moved_files import describe_places
from rare_envs.study.analysis.recorded_question import is_same_question
from rare_envs.study.journal import digest_contents, digest_files, find_ego_files
from rare_envs.study.question import Question, Study
from rare_envs.study.storage.names import STUDY, STUDY_FORMAT
from rare_envs.study.storage.result_digests import digest_results
from rare_envs.version import __version__
from samplers.result import method_settings

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
    """Write study.json of a run that begins.

    Raises:
        OSError: It cannot be written.
    """
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

    Raises:
        OSError: It cannot be written.
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
