"""Corpus: failures kept as regression scenarios, each a file, and what another ego does in them."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import math
import reprlib
import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

import agents
from agents.loading import find_ego_kind
from agents.saved_ego import load_saved_ego
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.files import parse_json_object, read_text_file, replace_file, replace_text
from rare_envs.make import set_up
from rare_envs.plugins import clean_text
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.registry import find_scenario
from rare_envs.startup import __version__
from rare_envs.study.arguments import BadInput, Question, as_bad_input, output_folder, read_question
from rare_envs.study.failures import OTHER_DRIVERS
from rare_envs.study.question import build_problem, note_question, open_question, open_run
from rare_envs.study.replay import REPLAY_TOLERANCE, join_parts
from rare_envs.study.run_folder import CRASH, LoadedStudy, load_finished
from samplers.output import to_json_value
from training import Retraining

STORED_FORMAT = 1
"""Number of the format."""
MAX_CORPUS_FILES = 100_000
"""Files of a corpus that are read."""
MAX_WORD = 300
"""Letters of a word that is shown."""
WORLD_FIELDS = ("measure", "gamma", "noise", "drivers", "horizon", "collisions", "weather")
"""Fields of a `Question` that decide what happens in a scenario and what counts as a failure, the ego apart."""


@dataclass(frozen=True)
class StoredFailure:
    """A scenario in which an ego failed."""

    env_id: str
    world: Mapping[str, Any]
    x: Mapping[str, list[float]]
    f: float
    log_p0: float
    ego: str = ""
    crash: str = ""
    base: str | None = None
    versions: Mapping[str, str] | None = None

    @property
    def digest(self) -> str:
        """SHA-256 of what decides the scenario: environment, world and x."""
        content = [self.env_id, dict(self.world), dict(self.x)]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def key(self) -> str:
        """First letters of `digest`: the name of its file."""
        return self.digest[:16]

    @property
    def gamma(self) -> float:
        """Threshold: f of this or less is a failure."""
        return float(self.world["gamma"])

    def question_values(self) -> dict[str, Any]:
        """Return the scenario as values of a `Question`, with the rule-based ego in it."""
        return {"env_id": self.env_id, "ego": "idm", **self.world}

    def to_json(self) -> str:
        """Return the text of its file; f and log p0 that are no numbers are null."""
        content = {"format": STORED_FORMAT, "sha256": self.digest, **to_json_value(asdict(self))}
        return json.dumps(content, allow_nan=False, indent=1) + "\n"


def make_stored(
    question: Question, x: Mapping[str, NDArray[np.float64]], f: float, log_p0: float, crash: str
) -> StoredFailure:
    """Return a failure of a run as it is stored; its base is the scenario's default where the question names none."""
    values = {name: np.atleast_1d(part).astype(np.float64).tolist() for name, part in x.items()}
    world = {name: getattr(question, name) for name in WORLD_FIELDS}
    versions = {"rare_envs": __version__, "torch": torch.__version__, "numpy": np.__version__}
    try:
        base = question.base or find_scenario(question.env_id).default_base
    except ValueError:  # a scenario of the user's that is gone
        base = None
    return StoredFailure(question.env_id, world, values, f, log_p0, question.ego, crash, base, versions)


def parse_stored(text: str, source: str) -> StoredFailure:
    """Return the failure that a file has, which anybody may have written; `source` is its name, for messages."""
    content = parse_json_object(text, source)
    if content.get("format") != STORED_FORMAT:
        raise ValueError(f"{source}: expected format {STORED_FORMAT}, got {reprlib.repr(content.get('format'))}.")
    values: dict[str, Any] = {each.name: content.get(each.name) for each in fields(StoredFailure)}
    words, world, x = [values[name] for name in ("env_id", "ego", "crash")], values["world"], values["x"]
    if not (
        all(isinstance(word, str) and len(word) <= MAX_WORD for word in words)
        and isinstance(values["base"], str | None)
        and (isinstance(world, dict) and set(world) == set(WORLD_FIELDS))
        and (isinstance(x, dict) and x and all(isinstance(row, list) for row in x.values()))
        and all(values[name] is None or _is_number(values[name]) for name in ("f", "log_p0"))
        and all(map(_is_number, [world["gamma"], *itertools.chain(*x.values())]))
    ):
        raise ValueError(
            f"{source} is no stored failure: expected env_id, ego and crash of up to {MAX_WORD} letters, a base, "
            f"a world with {', '.join(WORLD_FIELDS)}, x with lists of numbers by name, f and log_p0."
        )
    for name in ("f", "log_p0"):
        values[name] = math.nan if values[name] is None else float(values[name])
    stored = StoredFailure(**values)
    if stored.digest != content.get("sha256"):
        raise ValueError(f"{source}: the scenario is not the one that was stored (its sha256 differs).")
    return stored


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]


def read_corpus(folder: Path) -> list[StoredFailure]:
    """Read a corpus, in the order of its files' names; a BadInput if there is none, or a file is damaged."""
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise BadInput(f"There is no corpus in {str(folder)!r}: rare-envs corpus add RUN makes one.")
    if len(paths) > MAX_CORPUS_FILES:
        raise BadInput(f"The corpus in {str(folder)!r} has more than {MAX_CORPUS_FILES:,} files.")
    found = []
    with as_bad_input(ValueError, OSError):
        for path in paths:
            found.append(parse_stored(read_text_file(path), repr(str(path))))
    return found


def list_failures(run: LoadedStudy, trust: bool = False, **given: Any) -> list[StoredFailure]:
    """Return the failures of a run, the most likely first; no ego is loaded. `given` is as for `open_question`."""
    question, table = replace(open_run(run, trust, **given), ego=read_question(run.question).ego), run.failures
    others = [f"f_{name}" for name in OTHER_DRIVERS]
    names = [name for name in table if name not in ("f", "log_p0", *CRASH, *others)]
    if not names or not all(np.isfinite(table[name]).all() for name in names):
        raise BadInput(f"The files of failures in {str(run.folder)!r} are damaged: a parameter is no number.")
    rows = zip(table["f"], table["log_p0"], table.get(CRASH[0], [""] * len(table["f"])), strict=True)
    return [
        make_stored(question, {name: table[name][k] for name in names}, float(f), float(log_p0), str(crash))
        for k, (f, log_p0, crash) in enumerate(rows)
    ]


def add_run(run: Path, corpus: Path, most: int = 20, trust: bool = False) -> tuple[list[StoredFailure], int]:
    """Add the `most` likely failures of a run to a corpus, and return them and how many of them are new."""
    if most < 1:
        raise BadInput(f"Expected at least one failure to add, got {most}.")
    study = load_finished(run)
    failures = list_failures(study, trust)
    first = {failure.crash: number for number, failure in reversed(list(enumerate(failures)))}
    of_modes = [number for number in study.modes if number is not None and 0 <= number < len(failures)]
    order = list(dict.fromkeys([*sorted(first.values()), *of_modes, *range(len(failures))]))
    chosen = [failures[number] for number in sorted(order[:most])]
    if not chosen:
        raise BadInput(f"The run in {str(run)!r} has no failure.")
    new = 0
    with output_folder(corpus), as_bad_input(OSError):
        for failure in chosen:
            path = corpus / f"{failure.key}.json"
            if not path.exists():
                replace_text(path, failure.to_json())
                new += 1
    with contextlib.suppress(BadInput):
        open_run(study, trust=False)  # what needed trust needs it again
        for failure in chosen:
            note_question(read_question(failure.question_values()))
    return chosen, new


def join_x(failures: Sequence[StoredFailure], space: ScenarioSpace) -> NDArray[np.float64]:
    """Return x (n, d) of failures for a problem with these parameters, see `replay.join_parts`."""
    rows = []
    for failure in failures:
        try:
            rows.append(join_parts(failure.x, space))
        except ValueError as error:
            wrong = f"Stored failure {failure.key} {error}: {failure.env_id} or its drivers have changed since."
            raise ValueError(wrong) from error
    return np.array(rows, dtype=np.float64)


@dataclass(frozen=True)
class Trial:
    """An ego in one stored scenario."""

    failure: StoredFailure
    outcome: Literal["passed", "failed", "error"]
    f: float
    crash: str = ""
    reason: str = ""

    @property
    def same(self) -> bool:
        """Whether f is the one that was recorded."""
        return abs(self.f - self.failure.f) <= REPLAY_TOLERANCE or (math.isnan(self.f) and math.isnan(self.failure.f))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        stored = self.failure
        own = {"key": stored.key, "env_id": stored.env_id, "outcome": self.outcome, "f": self.f, "gamma": stored.gamma}
        recorded = {"f_recorded": stored.f, "crash_recorded": stored.crash, "ego_recorded": stored.ego}
        found: dict[str, Any] = to_json_value({**own, **recorded, "crash": self.crash, "reason": self.reason})
        return found

    def describe(self) -> str:
        """Return what happened, in a line."""
        if self.outcome == "error":
            return f"the ego failed to answer: {self.reason}"
        how = f", {self.crash}" if self.crash not in ("", "none") else ""
        before = f"; recorded f = {self.failure.f:.4g} of {self.failure.ego or 'an ego'}"
        return f"f = {self.f:.4g} {'<=' if self.outcome == 'failed' else '>'} {self.failure.gamma:g}{how}{before}"


def try_ego(
    failures: Sequence[StoredFailure],
    folder: Path | None,
    ego: str,
    *,
    algo: str | None = None,
    stats: str | None = None,
    observation: str | None = None,
    action: str | None = None,
    trust: bool = False,
) -> tuple[list[Trial], float]:
    """Return a trial of an ego in each of some scenarios from a folder, and the wall time of all [s].

    The folder's questions are judged by `open_question`; None for those of a run that the caller has opened.
    """
    worlds: dict[str, list[int]] = {}
    for number, failure in enumerate(failures):
        worlds.setdefault(json.dumps(failure.question_values(), sort_keys=True), []).append(number)
    questions = [
        open_question(asked, folder, trust) if folder else replace(read_question(asked), trust=trust)
        for asked in map(json.loads, worlds)
    ]
    start = time.perf_counter()
    trials: dict[int, Trial] = {}
    with as_bad_input(ValueError, OSError, ImportError), np.errstate():
        loaded = agents.load_ego(ego, algo=algo, trust=trust, stats=stats)
        for question, numbers in zip(questions, worlds.values(), strict=True):
            problem = build_problem(replace(question, ego=ego, observation=observation, action=action), loaded)
            trials |= zip(numbers, try_world(problem, [failures[k] for k in numbers]), strict=True)
    return [trials[number] for number in range(len(failures))], time.perf_counter() - start


def try_world(problem: DrivingProblem, failures: Sequence[StoredFailure]) -> list[Trial]:
    """Return the trials of the ego of a problem in scenarios of its world."""
    x = problem.space.validate(join_x(failures, problem.space))
    f, reasons = problem.attempt(x)
    failed = [k for k in range(len(x)) if k not in reasons and f[k] <= failures[k].gamma]
    kinds = dict(zip(failed, problem.crash_kinds(x[failed]) if failed else (), strict=True))
    return [
        Trial(failure, "error", math.nan, reason=reasons[k])
        if k in reasons
        else Trial(failure, "failed" if k in kinds else "passed", float(f[k]), kinds.get(k, ""))
        for k, failure in enumerate(failures)
    ]


def write_junit(path: Path, trials: Sequence[Trial], ego: str, seconds: float) -> None:
    """Write a report of test cases, one for each stored scenario; `seconds` is the wall time of all of them."""
    outcomes = [trial.outcome for trial in trials]
    failed, errors = str(outcomes.count("failed")), str(outcomes.count("error"))
    counts = {"tests": str(len(trials)), "failures": failed, "errors": errors, "time": f"{seconds:.3f}"}

    def add(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
        return ET.SubElement(parent, tag, {name: clean_text(text) for name, text in attributes.items()})

    root = ET.Element("testsuites", counts)
    suite = add(root, "testsuite", name=f"rare-envs corpus, ego {ego}", skipped="0", **counts)
    for trial in trials:
        time = f"{seconds / len(trials):.3f}"
        case = add(suite, "testcase", classname=trial.failure.env_id, name=trial.failure.key, time=time)
        if trial.outcome != "passed":
            kind = "failure" if trial.outcome == "failed" else "error"
            element = add(case, kind, message=trial.describe(), type=trial.crash or kind)
            element.text = element.get("message")
    ET.indent(root)
    with replace_file(path) as draft:
        ET.ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)


TRAINED_FIELDS = ("base", "drivers", "observation", "action", "horizon", "noise", "weather", "collisions")
"""Fields of a `Question` that are keyword arguments of the environment to train in."""


class RetrainingPlan(NamedTuple):
    """Arguments of `training.train_ego` that runs tell."""

    env_id: str
    algo: str
    """Algorithm of the ego."""
    world: Mapping[str, Any]
    """Keyword arguments of the environment, `TRAINED_FIELDS`, and trust where it was given."""
    retraining: Retraining
    next_seed: int
    """Least seed above those of the runs, for an estimate that shares no draw with them."""


def plan_retraining(folders: Sequence[Path], share: float, trust: bool = False) -> RetrainingPlan:
    """Return how to train the ego of the last of some runs on with the failures of all."""
    runs = [load_finished(folder) for folder in folders]
    questions = [open_run(run, trust) for run in runs]
    failures = [failure for run in runs for failure in list_failures(run, trust)]
    last, place = questions[-1], repr(str(folders[-1]))
    for folder, question in zip(folders, questions, strict=True):
        for name in ("env_id", *TRAINED_FIELDS):
            one, other = getattr(question, name), getattr(last, name)  # fields by their names
            if one != other:
                raise BadInput(
                    f"Expected runs of one environment with the same options, got {name} = {one!r} in "
                    f"{str(folder)!r} and {other!r} in {place}."
                )
    if not failures:
        raise BadInput(f"There is no failure in {', '.join(repr(str(folder)) for folder in folders)} to train with.")
    if find_ego_kind(last.ego) != "zip":
        raise BadInput(f"Expected a run of an ego that train-ego has saved (.zip) in {place}, got {last.ego!r}.")
    world = {name: getattr(last, name) for name in TRAINED_FIELDS}
    world |= {"observation": last.observation or "features", "action": last.action or "continuous"}
    world |= {"trust": True} if trust else {}
    with as_bad_input(ValueError, OSError):
        saved = load_saved_ego(Path(last.ego), last.algo, trust, last.stats)
        if saved.statistics is not None:
            raise ValueError(
                f"Cannot train {last.ego!r} on: it was trained behind VecNormalize, which train-ego has not."
            )
        _, space = set_up(last.env_id, **world)
        retraining = Retraining(Path(last.ego), join_x(failures, space), share)
    return RetrainingPlan(last.env_id, saved.algorithm, world, retraining, 1 + max(each.seed for each in questions))
