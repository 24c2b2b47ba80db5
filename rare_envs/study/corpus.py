"""Corpus: failures kept as regression scenarios, each a file, and what another ego does in them."""

from __future__ import annotations

import hashlib
import json
import math
import re
import reprlib
import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

import agents
from agents.loading import find_ego_kind
from agents.saved_ego import load_saved_ego
from rare_envs.files import check_ordinary, parse_json_object, replace_file, replace_text
from rare_envs.make import set_up
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.registry import find_scenario
from rare_envs.study.arguments import Question, read_question
from rare_envs.study.errors import BadInput, as_bad_input, output_folder
from rare_envs.study.question import build_problem, prepare
from rare_envs.study.recorded_question import load_finished, note_question, open_question, open_run
from rare_envs.study.run_folder import CRASH, LoadedStudy
from rare_envs.study.video import OWN_NOISE, REPLAY_TOLERANCE
from rare_envs.version import __version__
from training import Retraining

STORED_FORMAT = 1
"""Number of the format."""
MAX_STORED = 2**26
"""Bytes of a file that are read at most; 400,000 values take 10 MB."""
MAX_WORD = 300
"""Letters of a word that is shown."""
WORLD_FIELDS = ("measure", "gamma", "noise", "drivers", "horizon", "collisions", "weather")
"""Fields of a `Question` that decide what happens in a scenario and what counts as a failure, the ego apart."""


@dataclass(frozen=True)
class StoredFailure:
    """A scenario in which an ego failed.

    Attributes:
        env_id: The environment.
        world: Values of `WORLD_FIELDS`.
        x: Scenario parameters by name, each of shape (size,).
        f: The measure that was recorded.
        log_p0: Log density under the base distribution.
        ego: The ego that failed, as its run named it.
        crash: Kind of its crash, in words.
        base: Base distribution of the run; the scenario's default when None. It says how likely x is, and does not
            change what happens in it.
        versions: Versions of this program and of the libraries that simulate.
    """

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
        """Return the text of its file."""
        content = {"format": STORED_FORMAT, "sha256": self.digest, **asdict(self)}
        content["f"], content["log_p0"] = (value if math.isfinite(value) else None for value in (self.f, self.log_p0))
        return json.dumps(content, allow_nan=False, indent=1) + "\n"


def make_stored(
    question: Question, x: Mapping[str, NDArray[np.float64]], f: float, log_p0: float, crash: str
) -> StoredFailure:
    """Return a failure of a run as it is stored."""
    values = {name: np.atleast_1d(part).astype(np.float64).tolist() for name, part in x.items()}
    world = {name: getattr(question, name) for name in WORLD_FIELDS}
    versions = {"rare_envs": __version__, "torch": torch.__version__, "numpy": np.__version__}
    base = _name_base(question)
    return StoredFailure(question.env_id, world, values, f, log_p0, question.ego, crash, base, versions)


def _name_base(question: Question) -> str | None:
    """Return the name of the base distribution, the scenario's default where the question names none."""
    try:
        return question.base or find_scenario(question.env_id).default_base
    except ValueError:  # a scenario of the user's that is not there any longer
        return None


def parse_stored(text: str, source: str) -> StoredFailure:
    """Return the failure that a file has, which anybody may have written; `source` is its name, for messages."""
    content = parse_json_object(text, source)
    if content.get("format") != STORED_FORMAT:
        raise ValueError(f"{source}: expected format {STORED_FORMAT}, got {reprlib.repr(content.get('format'))}.")
    try:
        values = {each.name: content[each.name] for each in fields(StoredFailure)}
    except KeyError as error:
        raise ValueError(f"{source} has no {error}.") from None
    _check_words(values, source)
    _check_numbers(values, source)
    for name in ("f", "log_p0"):
        values[name] = math.nan if values[name] is None else float(values[name])
    stored = StoredFailure(**values)
    if stored.digest != content.get("sha256"):
        raise ValueError(f"{source}: the scenario is not the one that was stored (its sha256 differs).")
    return stored


def _check_words(values: Mapping[str, Any], source: str) -> None:
    words = (values["env_id"], values["ego"], values["crash"])
    if not all(isinstance(word, str) and len(word) <= MAX_WORD for word in words):
        raise ValueError(f"{source}: expected env_id, ego and crash of up to {MAX_WORD} letters.")
    if values["base"] is not None and not isinstance(values["base"], str):
        raise ValueError(f"{source}: expected base to be a name or null.")
    if not isinstance(values["world"], dict) or set(values["world"]) != set(WORLD_FIELDS):
        raise ValueError(f"{source}: expected a world with {', '.join(WORLD_FIELDS)}.")


def _check_numbers(values: Mapping[str, Any], source: str) -> None:
    rows = values["x"].values() if isinstance(values["x"], dict) else ()
    if not rows or not all(isinstance(row, list) and all(map(_is_number, row)) for row in rows):
        raise ValueError(f"{source}: expected x with lists of finite numbers by name.")
    if not _is_number(values["world"]["gamma"]) or not all(
        values[name] is None or _is_number(values[name]) for name in ("f", "log_p0")
    ):
        raise ValueError(f"{source}: expected gamma, f and log_p0 to be numbers.")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def read_stored(path: Path) -> StoredFailure:
    """Read a file of a corpus."""
    check_ordinary(path, MAX_STORED)
    content = path.read_bytes()
    return parse_stored(content.decode("utf-8", "replace"), repr(str(path)))


MAX_CORPUS_FILES = 100_000
"""Files of a corpus that are read at most."""


def read_run(folder: Path, trust: bool = False) -> list[StoredFailure]:
    """Return the failures of a run, the most likely first; nothing is simulated and no ego is loaded.

    Args:
        folder: Of `rare-envs estimate --out`.
        trust: Trust the code that a run from elsewhere names.

    Raises:
        BadInput: There is no such run, it is not finished, its files are damaged, or it is not trusted.
    """
    return _list_failures(load_finished(folder), trust)


def _list_failures(run: LoadedStudy, trust: bool) -> list[StoredFailure]:
    question, table = open_run(run, trust), run.failures
    names = [name for name in table if name not in ("f", "log_p0", *CRASH)]
    if not names or not all(np.isfinite(table[name]).all() for name in names):
        raise BadInput(f"The files of failures in {str(run.folder)!r} are damaged: a parameter is no number.")
    crashes = table.get(CRASH[0], [""] * len(table["f"]))
    return [
        make_stored(
            question,
            {name: table[name][k] for name in names},
            float(table["f"][k]),
            float(table["log_p0"][k]),
            str(crashes[k]),
        )
        for k in range(len(table["f"]))
    ]


def choose_likely(failures: Sequence[StoredFailure], most: int, modes: Sequence[int] = ()) -> list[StoredFailure]:
    """Return the `most` most likely failures, one of each kind of crash and mode among them as far as there is room."""
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
    """
    if most < 1:
        raise BadInput(f"Expected at least one failure to add, got {most}.")
    study = load_finished(run)
    failures = _list_failures(study, trust)
    chosen = choose_likely(failures, most, _find_modes(study.result, len(failures)))
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
    """
    rows = []
    for failure in failures:
        parts: list[Any] = []
        for name, size in zip(names, sizes, strict=True):
            part = failure.x.get(name)
            if name == OWN_NOISE and (part is None or len(part) != size):
                part = [0.0] * size
            if part is None or len(part) != size:
                raise ValueError(
                    f"Stored failure {failure.key} has {0 if part is None else len(part)} values of {name}, its "
                    f"scenario has {size}: {failure.env_id} or its drivers have changed since."
                )
            parts += part
        rows.append(parts)
    return np.array(rows, dtype=np.float64)


TrialOutcome = Literal["passed", "failed", "error"]


@dataclass(frozen=True, kw_only=True)
class EgoChoice:
    """An ego as options name it, and its interface."""

    ego: str
    algo: str | None = None
    stats: str | None = None
    observation: str | None = None
    action: str | None = None


@dataclass(frozen=True)
class Trial:
    """An ego in one stored scenario.

    Attributes:
        failure: The scenario.
        outcome: "passed" if f > gamma, "failed" if not, "error" if the ego failed to answer.
        f: Its measure; NaN after an error.
        crash: Kind of its crash, where it failed.
        reason: The error.
    """

    failure: StoredFailure
    outcome: TrialOutcome
    f: float
    crash: str = ""
    reason: str = ""

    @property
    def same(self) -> bool:
        """Whether f is the one that was recorded."""
        return abs(self.f - self.failure.f) <= REPLAY_TOLERANCE or (math.isnan(self.f) and math.isnan(self.failure.f))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "key": self.failure.key,
            "env_id": self.failure.env_id,
            "outcome": self.outcome,
            "f": self.f if math.isfinite(self.f) else None,
            "gamma": self.failure.gamma,
            "f_recorded": self.failure.f if math.isfinite(self.failure.f) else None,
            "crash": self.crash,
            "crash_recorded": self.failure.crash,
            "ego_recorded": self.failure.ego,
            "reason": self.reason,
        }


def try_ego(
    failures: Sequence[StoredFailure], choice: EgoChoice, folder: Path, trust: bool = False
) -> tuple[list[Trial], float]:
    """Drive an ego through stored scenarios, those of one world side by side.

    Args:
        failures: The scenarios.
        choice: The ego.
        folder: Where they are from, for messages.
        trust: Let the ego's file run code, and code that the scenarios name.

    Returns:
        A trial of each, in their order, and the wall time of all [s].

    Raises:
        BadInput: The ego cannot be used, or a scenario is not one of its world any longer.
    """
    worlds: dict[str, list[int]] = {}
    for number, failure in enumerate(failures):
        worlds.setdefault(json.dumps(failure.question_values(), sort_keys=True), []).append(number)
    questions = {text: open_question(json.loads(text), folder, trust) for text in worlds}
    start = time.perf_counter()
    with as_bad_input(ValueError, OSError, ImportError), np.errstate():
        ego = agents.load_ego(choice.ego, algo=choice.algo, trust=trust, stats=choice.stats)
        trials: dict[int, Trial] = {}
        for text, numbers in worlds.items():
            problem = _build(questions[text], choice, ego)
            trials |= zip(numbers, _try_world(problem, [failures[k] for k in numbers]), strict=True)
    return [trials[number] for number in range(len(failures))], time.perf_counter() - start


def repeat_run(folder: Path, trust: bool = False) -> tuple[list[Trial], float]:
    """Drive the ego of a run through its failures again; returns and errors as of `try_ego`."""
    start, run = time.perf_counter(), load_finished(folder)
    failures = _list_failures(run, trust)
    with as_bad_input(ValueError, OSError):
        problem = prepare(open_run(run, trust)).problem
        trials = _try_world(problem, failures)
    return trials, time.perf_counter() - start


def _build(question: Question, choice: EgoChoice, ego: Any) -> DrivingProblem:
    asked = replace(question, ego=choice.ego, observation=choice.observation, action=choice.action)
    return build_problem(asked, ego)


def _try_world(problem: DrivingProblem, failures: Sequence[StoredFailure]) -> list[Trial]:
    """Return the trials of scenarios of one world."""
    x = problem.space.validate(join_x(failures, problem.space.names, problem.space.sizes))
    f, reasons = problem.attempt(x)
    failed = np.array([k not in reasons and f[k] <= failures[k].gamma for k in range(len(x))])
    kinds = iter(problem.crash_kinds(x[failed]) if failed.any() else ())
    return [
        Trial(failure, "error", math.nan, reason=reasons[k])
        if k in reasons
        else Trial(failure, "failed" if failed[k] else "passed", float(f[k]), next(kinds) if failed[k] else "")
        for k, failure in enumerate(failures)
    ]


_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold."""


def write_junit(path: Path, trials: Sequence[Trial], ego: str, seconds: float) -> None:
    """Write a report of test cases, one for each stored scenario.

    Args:
        path: The file.
        trials: Of the ego.
        ego: Its name.
        seconds: Wall time of all of them [s].
    """
    outcomes = [trial.outcome for trial in trials]
    counts = {
        "tests": str(len(trials)),
        "failures": str(outcomes.count("failed")),
        "errors": str(outcomes.count("error")),
        "skipped": "0",
        "time": f"{seconds:.3f}",
    }
    root = ET.Element("testsuites", {name: value for name, value in counts.items() if name != "skipped"})
    suite = ET.SubElement(root, "testsuite", {"name": _clean(f"rare-envs corpus, ego {ego}"), **counts})
    for trial in trials:
        case = ET.SubElement(
            suite,
            "testcase",
            classname=_clean(trial.failure.env_id),
            name=trial.failure.key,
            time=f"{seconds / len(trials):.3f}",
        )
        if trial.outcome != "passed":
            kind = "failure" if trial.outcome == "failed" else "error"
            element = ET.SubElement(case, kind, message=_clean(describe_trial(trial)), type=_clean(trial.crash or kind))
            element.text = _clean(describe_trial(trial))
    ET.indent(root)
    with replace_file(path) as draft:
        ET.ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)


def describe_trial(trial: Trial) -> str:
    """Return what happened, in a line."""
    if trial.outcome == "error":
        return f"the ego failed to answer: {trial.reason}"
    how = f", {trial.crash}" if trial.crash not in ("", "none") else ""
    before = f"; recorded f = {trial.failure.f:.4g} of {trial.failure.ego or 'an ego'}"
    return f"f = {trial.f:.4g} {'<=' if trial.outcome == 'failed' else '>'} {trial.failure.gamma:g}{how}{before}"


def _clean(text: str) -> str:
    return _NOT_XML.sub("?", text)


TRAINED_FIELDS = ("base", "drivers", "observation", "action", "horizon", "noise", "weather", "collisions")
"""Fields of a `Question` that are keyword arguments of the environment to train in."""


@dataclass(frozen=True)
class RetrainingPlan:
    """Arguments of `training.train_ego` that runs tell."""

    env_id: str
    algo: str
    """Algorithm of the ego."""
    world: Mapping[str, Any]
    """Keyword arguments of the environment, `TRAINED_FIELDS`."""
    retraining: Retraining
    next_seed: int
    """Least seed above those of the runs, for an estimate that shares no draw with them."""


def plan_retraining(folders: Sequence[Path], share: float, trust: bool = False) -> RetrainingPlan:
    """Return how to train the ego of the last of some runs on with the failures of all."""
    runs = [load_finished(folder) for folder in folders]
    questions = [open_run(run, trust) for run in runs]
    failures = [failure for run in runs for failure in _list_failures(run, trust)]
    last = questions[-1]
    for folder, question in zip(folders, questions, strict=True):
        _check_same(question, last, folder, folders[-1])
    if not failures:
        raise BadInput(f"There is no failure in {', '.join(repr(str(folder)) for folder in folders)} to train with.")
    if find_ego_kind(last.ego) != "zip":
        raise BadInput(
            f"Expected a run of an ego that train-ego has saved (.zip) in {str(folders[-1])!r}, got {last.ego!r}."
        )
    world = {name: getattr(last, name) for name in TRAINED_FIELDS}
    world |= {"observation": last.observation or "features", "action": last.action or "continuous"}
    with as_bad_input(ValueError, OSError):
        saved = load_saved_ego(Path(last.ego), last.algo, trust, last.stats)
        if saved.statistics is not None:
            raise ValueError(
                f"Cannot train {last.ego!r} on: it was trained behind VecNormalize, which train-ego has not."
            )
        _, space = set_up(last.env_id, **world)
        retraining = Retraining(Path(last.ego), join_x(failures, space.names, space.sizes), share)
    return RetrainingPlan(last.env_id, saved.algorithm, world, retraining, 1 + max(each.seed for each in questions))


def _check_same(question: Question, last: Question, folder: Path, last_folder: Path) -> None:
    """Raise a BadInput if two runs are not of one environment with the same options."""
    for name in ("env_id", *TRAINED_FIELDS):
        one, other = getattr(question, name), getattr(last, name)  # fields by their names
        if one != other:
            raise BadInput(
                f"Expected runs of one environment with the same options, got {name} = {one!r} in {str(folder)!r} and "
                f"{other!r} in {str(last_folder)!r}."
            )
