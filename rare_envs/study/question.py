"""Study: a question with everything that it names, checked and loaded before the first simulation; and trust in it.

A question that a folder records is read from a file that anybody may have written, and asked for trust. Files that it
names have digests, and are found again where the folder has moved together with them.

A run's question may name code: an ego or a measure `module:name`, an environment that a module registers. Whoever asks
the question means that code. Whoever replays or resumes a folder that came from elsewhere does not, and modules are
found in the working directory, where such a folder may bring its own. So each run that is made here is noted, and a
folder whose question is not among these runs no code without trust.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

import agents
import samplers
from agents.loading import find_ego_kind, strip_prefixes
from agents.saved_ego import HUB_PREFIX, find_hub_model, find_statistics
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import Distribution
from rare_envs.egos.needs import EgoWarning
from rare_envs.files import parse_json_object, read_text_file
from rare_envs.measures.registry import MEASURES
from rare_envs.plugins import EgoGone
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.world import drive
from rare_envs.study.arguments import BadInput, Question, as_bad_input, read_question
from rare_envs.study.run_folder import STUDY, LoadedStudy, digest_file

MAX_NOTES = 2**24
"""Bytes of the notes that are read, the last ones: 250,000 runs."""


def note_own_run(question: Mapping[str, Any], code: Sequence[str]) -> None:
    """Note that a question with code `module:name` was asked here; the code may change and is still one's own."""
    if code:
        _append_note(_digest_own(question, code))


def check_code_trust(question: Mapping[str, Any], code: Sequence[str], folder: Path, trust: bool) -> None:
    """Refuse a folder's question that names code, unless it was asked here, or trusted before with the same code.

    With `trust` it is trusted from now on, for as long as question and code stay what they are.
    """
    trusted = _digest_trusted(question, code)
    if trust and code and trusted is not None:
        _append_note(trusted)
    if not trust and code and not {trusted, _digest_own(question, code)} & _read_notes():
        files = {name: find_module_file(name) for name in code}
        named = ", ".join(f"{name!r}{f' ({path})' if path else ''}" for name, path in files.items())
        raise ValueError(
            f"The run in {str(folder)!r} was not made here, and its question runs code: {named}. Look at that code, "
            "then add --trust (trust=True) once; that is remembered until question or code change."
        )


def find_module_file(name: str) -> Path | None:
    """Return the file of the module in `module:name`, found without running anything; None if there is none."""
    parts = name.partition(":")[0].split(".")
    for folder in (os.getcwd(), *sys.path):
        base = Path(folder, *parts)
        for path in (base / "__init__.py", base.with_name(f"{base.name}.py")):
            with contextlib.suppress(OSError, ValueError):
                if path.is_file():
                    return path.resolve()
    return None


def _digest_own(question: Mapping[str, Any], code: Sequence[str]) -> str:
    """Return what identifies a question and the places of its code."""
    return _digest("own", question, [[name, str(find_module_file(name))] for name in code])


def _digest_trusted(question: Mapping[str, Any], code: Sequence[str]) -> str | None:
    """Return what identifies a question and the content of its code; None where that content cannot be read.

    Importing `a.b` runs `a/__init__.py` too. A compiled module has no content here: trust in it is asked for each time.
    """
    contents = []
    for name in code:
        path = find_module_file(name)
        if path is None:
            return None
        folders = path.parents[: name.partition(":")[0].count(".") + (path.name == "__init__.py")]
        files = [path, *(folder / "__init__.py" for folder in folders)]
        try:
            content = b"".join(file.read_bytes() for file in files if file.exists())
        except OSError:
            return None
        contents.append([name, hashlib.sha256(content).hexdigest()])
    return _digest("trusted", question, contents)


def _digest(kind: str, question: Mapping[str, Any], code: list[list[str]]) -> str:
    return hashlib.sha256(json.dumps([kind, dict(question), code], sort_keys=True).encode()).hexdigest()


def find_notes() -> Path:
    """Return the file with the notes, in the user's folder for states of programs (XDG_STATE_HOME)."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "rare-envs" / "runs"


def _read_notes() -> set[str]:
    with contextlib.suppress(OSError), find_notes().open("rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - MAX_NOTES))
        return set(file.read().decode("ascii", "replace").split())
    return set()


def _append_note(digest: str) -> None:
    """Add a note, if there is not one; a folder that cannot be written to makes the next replay ask."""
    if digest in _read_notes():
        return
    with contextlib.suppress(OSError):
        find_notes().parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with find_notes().open("a", encoding="ascii") as file:
            file.write(f"{digest}\n")


NAMING_FILES = ("ego", "stats", "base", "drivers", "measure", "also_under")
"""Fields of a question that can name files."""
MAX_TEXT = 2**16
"""Letters of a name or formula in a question."""
CHANGEABLE = ("trust", "on_error", "core", "device")
"""Fields that a resumed run may change, or that follow from what is installed."""


@dataclass(frozen=True)
class Study:
    """A question with everything that it names, loaded and checked."""

    question: Question
    problem: DrivingProblem
    method: samplers.Stepping
    other_bases: Mapping[str, Distribution] = field(default_factory=dict)
    """Distributions of x under the other base distributions that the question names."""
    ego_was_given: bool = False
    """Whether the ego is an object of the caller's, and not the one that the question names."""

    @cached_property
    def base(self) -> Distribution:
        """The base distribution that the question names, with what is known of its events."""
        return load_base(find_scenario(self.question.env_id), self.question.base)

    def under(self, base: str) -> Study:
        """Return the same study with another base distribution, by name or file; the ego is the one that is loaded."""
        question = replace(self.question, base=base, ensemble=False)
        return replace(self, question=question, problem=build_problem(question, self.problem.ego))

    @property
    def base_name(self) -> str:
        """Its name or file."""
        return self.question.base or find_scenario(self.question.env_id).default_base


def prepare(question: Question, ego: Any = None) -> Study:
    """Check a question and load what it names; nothing is simulated.

    Args:
        question: The question.
        ego: The ego, where it is an object of yours; None to load the one that the question names.

    Returns:
        The study, ready to run.

    Raises:
        BadInput: Something in the question cannot be used.

    Example:
        >>> prepare(Question(env_id="rare_envs/CutIn-v0", seed=-1))
        Traceback (most recent call last):
            ...
        rare_envs.study.arguments.BadInput: Expected seed to be a whole number of at least 0, got -1.
    """
    with as_bad_input(ValueError, OSError), np.errstate():  # what an ego does to NumPy's errors ends here
        method = question.check()
        given = ego is not None
        if ego is None:
            ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        problem = build_problem(question, ego)
        _check_threshold(question)
        observation, action = problem.world.sensing.observation, problem.world.clock.action
        study = Study(replace(question, observation=observation, action=action, core=problem.core), problem, method)
        names = [name.strip() for name in (question.also_under or "").split(",") if name.strip()]
        if question.also_under is not None and (not names or len(set(names)) < len(names)):
            raise ValueError(
                f"Expected --also-under with one base or more, each once, such as i80; got {question.also_under!r}."
            )
        others = {name: study.under(name).problem.base for name in names}
    problem.varies = problem.varies or _answers_vary(problem)
    return replace(study, other_bases=others, ego_was_given=given)


def _check_threshold(question: Question) -> None:
    """Refuse a threshold below every value that a measure of this package takes; warn of one at which crashes count."""
    measure = MEASURES.get(question.measure)
    least = getattr(measure, "collision", None)
    if not isinstance(least, float) or question.gamma >= 0.0:
        return
    if question.gamma < least:
        raise ValueError(
            f"Expected gamma of at least {least:g}, which is f of a collision and the least value of "
            f"{question.measure}, got {question.gamma:g}: f <= gamma cannot happen. Take --gamma 0 for collisions."
        )
    if getattr(measure, "collisions_only", False):
        warnings.warn(
            f"{question.measure} is below 0 in collisions alone, where it is {least:g}: --gamma {question.gamma:g} "
            "counts collisions, as --gamma 0 does; --measure margin grades them by speed.",
            stacklevel=3,
        )


def build_problem(question: Question, ego: Any) -> DrivingProblem:
    """Return the problem of a question; what it cannot check is among its notes, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EgoWarning)  # the report says it
        return DrivingProblem(
            question.env_id,
            ego=ego,
            measure=question.measure,
            base=_load_ensemble(question) if question.ensemble else question.base,
            noise=question.noise,
            drivers=question.drivers,
            horizon=question.horizon,
            collisions=question.collisions,
            observation=question.observation,
            weather=question.weather,
            action=question.action,
            core=question.core,
            device=question.device,
        )


def _load_ensemble(question: Question) -> Distribution:
    """Return the mixture of the refits of the base distribution."""
    base = load_base(find_scenario(question.env_id), question.base)
    if not isinstance(base, FittedDistribution) or not base.refits:
        name = "the default" if question.base is None else repr(question.base)
        raise ValueError(f"The base distribution ({name}) has no refits, so there is no ensemble of them.")
    return base.ensemble()


@torch.inference_mode()
def _answers_vary(problem: DrivingProblem) -> bool:
    """Return whether the ego answers differently when it is queried twice with ordinary traffic at time 0.

    This finds a broken ego before the simulations, and one whose answers vary from run to run.
    """
    x = torch.from_numpy(problem.space.sample(2, np.random.default_rng(0))).float().to(problem.device)
    try:
        first, again = (list(itertools.islice(drive(problem.world, problem.driver, x), 2))[1] for _ in range(2))
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
        words = "" if isinstance(error, SystemExit) else str(error)
        raise BadInput(f"The ego fails on its first observation: {words or repr(error)}") from error
    same = torch.equal(first.state.speed, again.state.speed) and torch.equal(first.state.heading, again.state.heading)
    return not same


def digest_files(question: Question) -> dict[str, str]:
    """Return the digests of the files that a question names, by path; modules are found, not imported.

    The `VecNormalize` statistics that are read with its ego are among them.
    """
    bases = map(str.strip, (question.also_under or "").split(","))
    names = filter(None, (question.base, question.drivers, question.measure, *bases))
    paths = {path for name in names for path in find_named_files(name)}
    return {str(path): digest_file(path) for path in sorted(paths | set(find_ego_files(question)))}


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
        cached = find_hub_model(name, download=False)
        return [] if cached is None else [cached]
    parts = name.split(":")
    with contextlib.suppress(OSError, ValueError):  # too long a name, or with a null byte
        files = [path for path in map(Path, (name, *parts)) if path.is_file()]
        modules = (find_module_file(part) for part in parts[:-1] if part.replace(".", "_").isidentifier())
        return files or [path for path in modules if path is not None]
    return []


def find_changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the files of other content, those that are gone and those that are new; where a file lies does not matter.

    Example:
        >>> find_changed_files({"a.zip": "1"}, {"moved/a.zip": "1"}), find_changed_files({"a.zip": "1"}, {"a.zip": "2"})
        ([], ['a.zip'])
    """
    gone = {name for name, digest in before.items() if digest not in now.values()}
    new = {name for name, digest in now.items() if digest not in before.values()}
    return sorted(gone | new)


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


def find_moved_files(question: Question, folder: Path) -> Question:
    """Return the question of a run with files that are not where they were in the places that they have now.

    A file is looked for where it lay as seen from the folder of the run; its content must be what it was.
    """
    about = _read_about(folder)
    before, places = _texts(about.get("files")), _texts(about.get("file_places"))
    moved: dict[str, str] = {}
    with as_bad_input(OSError, ValueError):  # names of somebody else's making
        for name in sorted(before.keys() & places.keys()):
            old, path = Path(name), folder / places[name]
            if not path.is_file() or (old.is_file() and digest_file(old) == before[name]):
                continue
            if digest_file(path) == before[name]:
                moved[name] = str(path)
            elif not old.is_file():
                raise BadInput(
                    f"{str(path)!r} has changed since the run in {str(folder)!r} was begun, which names it as "
                    f"{name!r}: put the earlier file there, or begin anew."
                )
    renamed: dict[str, Any] = {name: _rename(getattr(question, name), moved) for name in NAMING_FILES}
    return replace(question, **renamed)


def _rename(value: str | None, moved: Mapping[str, str]) -> str | None:
    """Return what a field names, such as noisy:a.zip?delay=1, with the new paths of files."""
    for name, place in moved.items() if value is not None else ():
        value = place.join(re.split(rf"(?:^|(?<=[:,\s])){re.escape(name)}(?=$|[?:,\s])", str(value)))
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
        check_code_trust(_keep_asked(question), list_code(question), folder, trust)
    return find_moved_files(question, folder)


def note_question(question: Question) -> None:
    """Note that a question was asked here, so that its folder needs no trust."""
    note_own_run(_keep_asked(question), list_code(question))


def is_same_question(recorded: object, question: Question) -> bool:
    """Return whether a recorded question is this one, but for what a run that is resumed may change."""
    asked = _keep_asked(question)
    if find_ego_kind(question.ego) == "remote":
        del asked["ego"]  # its address may change
    return isinstance(recorded, Mapping) and all(recorded.get(name) == value for name, value in asked.items())


def list_code(question: Question) -> list[str]:
    """Return the code that a question names, as `module:name`."""
    ego, measure, env_id = strip_prefixes(question.ego), question.measure, question.env_id
    found = [ego] if find_ego_kind(ego) == "function" else []
    found += [measure] if ":" in measure and not measure.startswith("stl:") else []
    return found + ([env_id] if ":" in env_id else [])


def _keep_asked(question: Question) -> dict[str, Any]:
    return {name: value for name, value in asdict(question).items() if name not in CHANGEABLE}
