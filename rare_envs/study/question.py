"""Study: a question with everything that it names, checked and loaded before the first simulation; and trust in it.

A run's question may name code: an ego, drivers, a measure, a traffic model or a method `module:name`, an environment
that a module registers; or an ego or a driver in another program or on the Hub. Whoever asks the question means these.
Whoever replays or resumes a folder that came from elsewhere does not, and modules are found in the working directory,
where such a folder may bring its own. So each run that is made here is noted, and a folder whose question is not among
these runs no code and connects to nobody without trust. Files that a question names have digests.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import sys
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import numpy as np
import torch

import agents
import samplers
from agents.loading import find_ego_kind, names_function, strip_prefixes
from agents.saved_ego import HUB_PREFIX, find_hub_model, find_statistics
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import Distribution
from rare_envs.egos.needs import EgoWarning
from rare_envs.egos.policy import split_drivers
from rare_envs.files import digest_file, open_ordinary, read_json
from rare_envs.measures.registry import MEASURES
from rare_envs.plugins import EgoGone, names_object, split_settings
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.world import drive
from rare_envs.study.arguments import BadInput, Question, as_bad_input, read_question
from rare_envs.study.run_folder import STUDY, LoadedStudy
from samplers.problem import read_strata

MAX_NOTES = 2**24
"""Bytes of the notes that are read, the last ones: 250,000 runs."""


def note_question(question: Question) -> None:
    """Note that a question was asked here, so that its folder needs no trust; its code may change and is one's own."""
    digest = _digest_code(question)
    if list_risks(question) and digest not in _read_notes():
        with contextlib.suppress(OSError):  # a folder that cannot be written to makes the next replay ask
            find_notes().parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with find_notes().open("a", encoding="ascii") as file:
                file.write(f"{digest}\n")


def find_module_file(name: str) -> Path | None:
    """Return the file of the module in `module:name`, found without running anything; None if there is none."""
    places, spec = [os.getcwd(), *sys.path], None
    parts = [] if find_ego_kind(name) in ELSEWHERE else name.partition(":")[0].split(".")
    for last in range(len(parts)):  # a package first, as it runs first
        spec = PathFinder.find_spec(".".join(parts[: last + 1]), places)
        if spec is None:
            return None
        places = list(spec.submodule_search_locations or ())
    return None if spec is None or spec.origin is None else Path(spec.origin).resolve()


def _digest_code(question: Question) -> str:
    """Return what identifies a question and the places of its code."""
    code = [[name, str(find_module_file(name))] for names in list_risks(question).values() for name in names]
    return hashlib.sha256(json.dumps([_keep_asked(question), code], sort_keys=True).encode()).hexdigest()


def find_notes() -> Path:
    """Return the file with the notes, in the user's folder for states of programs (XDG_STATE_HOME)."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state", "rare-envs", "runs")


def _read_notes() -> set[str]:
    with contextlib.suppress(OSError, ValueError), open_ordinary(find_notes()) as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - MAX_NOTES))
        return set(file.read().decode("ascii", "replace").split())
    return set()


MAX_TEXT = 2**16
"""Letters of a name or formula in a question."""
ELSEWHERE = ("remote", "hub")
"""Kinds of egos that a connection is made for."""
PROBLEM_FIELDS = (
    *("measure", "noise", "drivers", "horizon", "collisions", "observation", "weather", "action", "core", "device"),
)
"""Fields of a question that are keyword arguments of `DrivingProblem`."""
CHANGEABLE = ("trust", "on_error", "core", "device")
"""Fields that a resumed run may change, or that follow from what is installed."""


@dataclass(frozen=True)
class Study:
    """A question with everything that it names, loaded and checked."""

    question: Question
    problem: DrivingProblem
    method: samplers.methods.Stepping
    other_bases: Mapping[str, Distribution] = field(default_factory=dict)
    """Distributions of x under the other traffic models that the question names."""
    ego_was_given: bool = False
    """Whether the ego is an object of the caller's, and not the one that the question names."""

    @cached_property
    def base(self) -> Distribution:
        """The traffic model that the question names, with what is known of its events."""
        return load_base(find_scenario(self.question.env_id), self.question.base)

    @property
    def fitted(self) -> FittedDistribution | None:
        """The same, if it was fitted to events; None if it was assembled otherwise."""
        return self.base if isinstance(self.base, FittedDistribution) else None

    def under(self, base: str) -> Study:
        """Return the same study with another traffic model, by name or file; the ego is the one that is loaded."""
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
                f"Expected also_under with one base or more, each once, such as i80; got {question.also_under!r}."
            )
        others = {name: study.under(name).problem.base for name in names}
    problem.varies = problem.varies or _answers_vary(problem, question.on_error)
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
        base: Any = question.base
        if question.ensemble:
            base = load_base(find_scenario(question.env_id), base)
            if not isinstance(base, FittedDistribution) or not base.refits:
                name = "the default" if question.base is None else repr(question.base)
                raise ValueError(f"The traffic model ({name}) has no refits, so there is no ensemble of them.")
            if strata := read_strata(base):
                names = ", ".join(each.name for each in strata)
                raise ValueError(
                    f"Expected a traffic model without strata for an ensemble of its refits, got one with {names}. "
                    "Leave ensemble out: the interval of p covers the refits without it."
                )
            base = base.ensemble()
        world = {name: getattr(question, name) for name in PROBLEM_FIELDS}
        return DrivingProblem(question.env_id, ego=ego, base=base, trust=question.trust, **world)


@torch.inference_mode()
def _answers_vary(problem: DrivingProblem, on_error: str) -> bool:
    """Return whether the ego answers differently when it is queried twice with two ordinary scenarios at time 0."""
    x = torch.from_numpy(problem.space.sample(2, np.random.default_rng(0))).float().to(problem.device)
    try:
        first, again = (list(itertools.islice(drive(problem.world, problem.driver, x), 2))[1] for _ in range(2))
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
        words = ("" if isinstance(error, SystemExit) else str(error)) or repr(error)
        if on_error != "raise":
            words = f"{words.rstrip('.')}. on_error: {on_error} counts scenarios of a run; this check comes before it"
        raise BadInput(f"The ego fails on its first observation of {problem.env_id}: {words}") from error
    same = torch.equal(first.state.speed, again.state.speed) and torch.equal(first.state.heading, again.state.heading)
    return not same


def digest_files(question: Question) -> dict[str, str]:
    """Return the digests of the files that a question names, by path; modules are found, not imported."""
    bases = map(str.strip, (question.also_under or "").split(","))
    names = filter(None, (question.base, question.drivers, question.measure, question.method, *bases))
    with as_bad_input(OSError, ValueError):
        paths = {path for name in names if not name.startswith(HUB_PREFIX) for path in find_named_files(name)}
        paths.update(find_ego_files(question), *map(_find_policy_files, _list_drivers(question)))
        return {str(path): digest_file(path) for path in sorted(paths)}


def find_ego_files(question: Question) -> list[Path]:
    """Return the files of the ego of a question, the `VecNormalize` statistics that it is loaded with included."""
    return _find_policy_files(question.ego, question.stats)


def _list_drivers(question: Question) -> list[str]:
    """Return what a question names as drivers: of single vehicles, or of all."""
    named = split_drivers(question.drivers or "")
    return [policy for _, policy in named] or [question.drivers or ""]


def _find_policy_files(name: str, stats: str | None = None) -> list[Path]:
    """Return the files of a policy with its statistics, which lie beside it if they are not named."""
    spec = strip_prefixes(name)
    files = find_named_files(spec)
    files += [data for path in files if (data := Path(f"{path}.data")).is_file()]  # weights of an ONNX file
    if find_ego_kind(spec) not in ("zip", "hub"):
        return files
    found = [Path(stats)] if stats else [find_statistics(path) for path in files]
    return [*files, *(path for path in found if path is not None and path.is_file())]


def find_named_files(name: str) -> list[Path]:
    """Return the files that an option names, or that of its module: a.zip, hf:user/a, module:function?file=a.pt."""
    if name.startswith(HUB_PREFIX):
        cached = find_hub_model(name, download=False)
        return [] if cached is None else [cached]
    spec, settings = split_settings(name) if names_function(name) else (name, {})
    parts = spec.split(":")
    with contextlib.suppress(OSError, ValueError):  # too long a name, or with a null byte
        files = [path for path in map(Path, (name, *parts)) if path.is_file()]
        named = map(Path, filter(os.path.exists, settings.values()))  # folders too
        found = itertools.chain.from_iterable((path, *path.rglob("*")) for path in named)
        given = [path for path in found if path.is_file()]
        modules = (find_module_file(part) for part in parts[:-1] if part.replace(".", "_").isidentifier())
        return [*(files or [path for path in modules if path is not None]), *given]
    return []


def find_changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the files of other content, that are gone, or that are new; where a file lies does not matter."""
    gone = {name for name, digest in before.items() if digest not in now.values()}
    new = {name for name, digest in now.items() if digest not in before.values()}
    return sorted(gone | new)


def warn_of_changed_files(question: Question, folder: Path) -> None:
    """Warn where a file of a run, or the statistics beside its ego, are not what they were when it was begun."""
    before = read_about(folder).get("files")
    changed = find_changed_files(before, digest_files(question)) if isinstance(before, dict) else []
    if changed:
        warnings.warn(
            f"{', '.join(changed)} changed since the run in {str(folder)!r} was begun, whose numbers are of what it "
            "was before.",
            stacklevel=2,
        )


def read_about(folder: Path) -> dict[str, Any]:
    """Return what study.json holds; nothing where it cannot be read, which others tell."""
    try:
        return read_json(folder / STUDY)
    except (OSError, ValueError):
        return {}


def open_run(study: LoadedStudy, trust: bool, **given: Any) -> Question:
    """Return the question of a finished run, see `open_question`."""
    return open_question(study.result.get("question"), study.folder, trust, **given)


def open_question(recorded: object, folder: Path, trust: bool, **given: Any) -> Question:
    """Return the question of a folder as it will be used, with what its reader gives in the place of what it has.

    A BadInput says that a value is of a wrong type, or that what the folder names may not be used without trust.
    """
    asked = replace(read_question(recorded), trust=trust, core="auto", device="cpu")
    question = replace(asked, **given)
    if any(isinstance(value, str) and len(value) > MAX_TEXT for value in asdict(question).values()):
        raise BadInput(f"The question of the run in {str(folder)!r} has a name of more than {MAX_TEXT} letters.")
    risks = [name for field, names in list_risks(question).items() if field not in given for name in names]
    if risks and not trust and _digest_code(asked) not in _read_notes():
        files = {name: find_module_file(name) for name in risks}
        named = ", ".join(f"{name!r}{f' ({path})' if path else ''}" for name, path in files.items())
        elsewhere = {find_ego_kind(name) in ELSEWHERE for name in risks}
        does = " and ".join("connects to another program" if each else "runs code" for each in sorted(elsewhere))
        raise BadInput(
            f"The run in {str(folder)!r} was not made here, and its question {does}: {named}. Look at that, then add "
            "--trust (trust=True)."
        )
    return question


def split_question(recorded: object) -> tuple[object, object]:
    """Return the questions about A and about B of which a comparison was made."""
    if not isinstance(recorded, dict):
        return recorded, recorded
    b = {"ego": recorded.get("ego_b"), "algo": recorded.get("algo_b"), "stats": recorded.get("stats_b")}
    return {**recorded, "ego": recorded.get("ego_a")}, {**recorded, **b}


def is_same_question(recorded: object, question: Question) -> bool:
    """Return whether a recorded question is this one, but for what a run that is resumed may change."""
    asked = _keep_asked(question)
    if find_ego_kind(question.ego) == "remote":
        del asked["ego"]  # its address may change
    return isinstance(recorded, Mapping) and all(recorded.get(name) == value for name, value in asked.items())


def list_risks(question: Question) -> dict[str, list[str]]:
    """Return code that a question names, as `module:name`, and egos and drivers elsewhere, by field."""
    drivers, measure = question.drivers or "", question.measure
    whole = names_object(drivers) and not split_drivers(drivers)  # its module has no prefix
    bases = [question.base or "", *map(str.strip, (question.also_under or "").split(","))]
    # whether or not there is a file of that name at the moment: it may be gone when it is loaded
    found = {
        "ego": [name for name in [strip_prefixes(question.ego)] if _is_risky(name)],
        "drivers": [drivers] if whole else [*filter(_is_risky, map(strip_prefixes, _list_drivers(question)))],
        "measure": [measure] if ":" in measure and not measure.startswith("stl:") else [],
        "env_id": [name for name in [question.env_id] if ":" in name],
        "method": [name for name in [question.method] if ":" in name],
        "base": [*filter(names_object, bases[:1])],
        "also_under": [*filter(names_object, bases[1:])],
    }
    return {name: risks for name, risks in found.items() if risks}


def _is_risky(ego: str) -> bool:
    """Return whether an ego without prefixes is code or elsewhere."""
    return find_ego_kind(ego) in ELSEWHERE or names_function(ego)


def _keep_asked(question: Question) -> dict[str, Any]:
    return {name: value for name, value in asdict(question).items() if name not in CHANGEABLE}
