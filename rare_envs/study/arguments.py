"""Arguments of an evaluation, each written once: options, keys of YAML files, study.json and their table follow.

Errors in what a person gives, interruptions of a run and folders for output are here too.

`python -m rare_envs.study.arguments` prints the table. Importing this takes milliseconds, so that the command line
starts without torch.
"""

from __future__ import annotations

import contextlib
import inspect
import json
import math
import os
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rare_envs.files import read_text_file
from rare_envs.plugins import did_you_mean, import_object
from rare_envs.scenarios.registry import find_scenario, split_layout

if TYPE_CHECKING:
    from samplers import Estimate
    from samplers.executors import Executor
    from samplers.methods import Stepping
    from samplers.problem import OnError
    from samplers.run import RunArguments

MAX_MESSAGE = 2_000
"""Characters of a message, which may repeat a name or a value of any length; of a longer one the middle is left out."""
GATE_CODES = {"passes": 0, "fails": 4, "undecided": 5}
"""Exit codes of a comparison with a limit."""
FIRST_BATCH = "Stopped: no estimate yet, the first batch of simulations was not complete."
"""What is known of a run whose single simulations are not counted, before its method has an estimate."""


class BadInput(Exception):
    r"""Input that cannot be used; the message is one line, of at most `MAX_MESSAGE` characters, that says what to do.

    Example:
        >>> raise BadInput("Expected a seed,\n  got None.")
        Traceback (most recent call last):
            ...
        rare_envs.study.arguments.BadInput: Expected a seed, got None.
    """

    def __init__(self, message: object) -> None:
        text = " ".join(str(message).split())
        half = MAX_MESSAGE // 2 - 3
        super().__init__(text if len(text) <= MAX_MESSAGE else f"{text[:half]} ... {text[-half:]}")


class UnwrittenResults(BadInput):
    """A run is done, but its results could not be written; `report` is the answer, a `Report`."""

    def __init__(self, message: str, report: Any) -> None:
        super().__init__(message)
        self.report = report


class RunInterrupted(KeyboardInterrupt):
    """A run was interrupted; the message says what is known and how to continue it."""

    def __init__(self, message: str, report: Any = None) -> None:
        super().__init__(message)
        self.report = report


def describe_stop(estimate: Estimate, name: str = "p") -> str:
    """Return what a run knows that was stopped, in one line; `name` is that of the probability."""
    n, (low, high), so_far = estimate.n_sim, estimate.interval, estimate.status == "stopped"
    return (
        f"{f'Stopped after {n:,} simulations' if so_far else f'Stopped behind the last of {n:,} simulations'}: "
        f"{name}{' so far' if so_far else ''} {estimate.p:.3e} "
        f"({100 * estimate.confidence:g} % interval {low:.3e} to {high:.3e})."
    )


@contextlib.contextmanager
def keep_answer(report: Any) -> Iterator[None]:
    """Let an interruption of what follows a `Report` say its estimate, as a RunInterrupted."""
    try:
        yield
    except KeyboardInterrupt:
        raise RunInterrupted(describe_stop(report.estimate), report) from None


@contextlib.contextmanager
def as_bad_input(*kinds: type[BaseException]) -> Iterator[None]:
    """Raise errors of these kinds as `BadInput`."""
    try:
        yield
    except kinds as error:
        raise BadInput(error) from error


@contextlib.contextmanager
def output_folder(path: Path, *files: str, folders: Iterable[str] = ()) -> Iterator[None]:
    """Make the folder for results, and folders in it, before the work, so that no run ends without a place to write to.

    Folders in the way of its files are refused, and links in the place of those folders, which may lead out of it.
    """
    inside = [path / name for name in folders]
    new = [folder for folder in (*inside, path, *path.parents) if not os.path.exists(folder)]
    try:
        for link in filter(Path.is_symlink, inside):
            raise BadInput(f"{str(link)!r} is a link, and nothing is written through one: remove it.")
        for folder in filter(Path.is_dir, (path / file for file in files)):
            if not folder.is_symlink():  # which is replaced
                raise BadInput(f"Cannot write {str(folder)!r}: there is a folder of that name.")
        for folder in (path, *inside):
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                reason = "there is a file of that name" if os.path.isfile(folder) else error.strerror
                raise BadInput(f"Cannot make the folder {str(folder)!r}: {reason}.") from error
            if not os.access(folder, os.W_OK):
                raise BadInput(f"Cannot write to the folder {str(folder)!r}.")
        yield
    except BaseException:
        for folder in new:  # the innermost first
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def refuse_existing(force: bool, *paths: Path | None) -> None:
    """Raise a BadInput if something of these names is there already and is not to be replaced."""
    for path in paths:
        if path is not None and not force and os.path.lexists(path):
            raise BadInput(f"There is {str(path)!r} already: choose another name, or replace it by --force.")


@contextlib.contextmanager
def output_file(path: Path | None, force: bool = True) -> Iterator[None]:
    """Make the folder of a file before the work, as `output_folder` does; None where there is none to write."""
    refuse_existing(force, path)
    with contextlib.nullcontext() if path is None else output_folder(path.parent, path.name):
        yield


EXECUTORS = ("local", "ray")
_KINDS: dict[str, tuple[tuple[type, ...], str]] = {
    "str": ((str,), "a text"),
    "int": ((int,), "a whole number"),
    "float": ((int, float), "a number"),
    "bool": ((bool,), "true or false"),
    "None": ((type(None),), "null"),
}
"""Words in the annotations of fields to types in JSON, and to what messages call them."""


def arg(default: Any, help: str, **about: Any) -> Any:
    """Return a field with the text of its option."""
    return field(default=default, metadata={"help": help, **about})


@dataclass(frozen=True, kw_only=True)
class Question:
    """All inputs of an evaluation: the same question gives the same answer.

    Example:
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", ego="idm", gamma=3.0, seed=1)
        >>> question.run_arguments.gamma, question.method
        (3.0, 'auto')
    """

    env_id: str = field(metadata={"help": "Environment, such as rare_envs/CutIn-v0.", "option": "env"})
    base: str | None = arg(None, "Base distribution: a name or a JSON file.")
    drivers: str | None = arg(
        None, "Of the vehicles around: mgail, mgail?rules=0, gail, idm, idm+mobil, a file, or cutter=POLICY.zip."
    )
    observation: str | None = arg(
        None,
        "Observation of the ego: features, lidar, kinematics, camera, speed, or camera+lidar; by default the "
        "one that the ego's space fits.",
    )
    action: str | None = arg(
        None,
        "Actions of the ego: continuous or discrete, each tick, or HighwayEnv's meta, each second; by default "
        "those that its space fits.",
    )
    horizon: float | None = arg(None, "Length of an episode in seconds.")
    noise: bool | str = arg(True, "The drivers' noise: part of x, one fixed sequence, none.")
    weather: bool = arg(False, "Make weather and the camera's noise parameters.")
    method: str = arg("auto", "Estimation method (see rare-envs list methods), or module:Class.")
    measure: str = arg("ttc", "Safety measure f, small is dangerous: a name, module:function or stl:FORMULA.")
    gamma: float = arg(0.0, "Threshold: P[f <= gamma]; 0 counts collisions.")
    seed: int = arg(0, "Seed; the same seed gives the same answer.", count=True)
    collisions: str = arg("ego", "Which count: ego, or any, between others too.")
    device: str = arg(
        "cpu", "Where torch simulates: cpu, or a GPU (cuda, cuda:1), which leaves numba out: docs/executors.md."
    )
    ensemble_run: bool = arg(
        True,
        "Where the failures found do not reach the refits of the base, simulate up to as much again under these.",
        flags="--ensemble-run/--no-ensemble-run",
    )
    trust: bool = arg(False, "Let code run: of the ego's .zip, though others can write to it; of a run from elsewhere.")
    ego: str = arg("idm", "A name, a .zip or .onnx, module:function, tcp://..., noisy:EGO; see rare-envs list egos.")
    algo: str | None = arg(None, "Algorithm of the .zip, if the file does not tell.")
    stats: str | None = arg(None, "File of the .zip's VecNormalize statistics; by default one is looked for beside it.")
    ensemble: bool = arg(False, "Take the mixture of the refits of the base: p for the next event.")
    also_under: str | None = arg(None, "State p under these bases too, by the same simulations: us101-closing,i80.")
    max_sim: int | None = arg(
        None, "Largest number of simulations.", count=True, show_default="that of the method, 6,000 for two-stage"
    )
    target_cov: float | None = arg(None, "Stop at this coefficient of variation.")
    replicates: int = arg(1, "Independent runs, combined by their mean.")
    on_error: str = arg("raise", "Where the ego fails twice: raise, failure or bound.")
    chunk: int | None = arg(None, "Simulations at once, few for a slow ego; with --workers 256, and 4,096 of rules.")
    core: str = arg("auto", "What simulates: torch, numba (compiled, where it can be had: docs/executors.md), or auto.")
    sensitivity: bool = arg(False, "Show what p is sensitive to: parameters of traffic and of its model.")
    max_p: float | None = arg(
        None, "Limit of p: the exit code is 0 if it passes, 4 if it fails, 5 if that is undecided."
    )
    max_rate: float | None = arg(None, "Limit of the collisions per million km, in place of --max-p; exit codes alike.")
    gate_confidence: float = arg(0.95, "One-sided, of the comparison with the limit.", option="confidence")
    assume_traffic: bool = arg(False, "Compare with the limit as if the traffic model were exact: of the ego alone.")

    def __post_init__(self) -> None:
        """Take an id with HighwayEnv's layout as that of the scenario, with the observation and actions it means."""
        env_id, layout = split_layout(self.env_id)
        object.__setattr__(self, "env_id", env_id)
        if layout:
            object.__setattr__(self, "observation", self.observation or layout["observation"])
            object.__setattr__(self, "action", self.action or layout["action"])

    @property
    def has_limit(self) -> bool:
        """Whether the answer is compared with a limit."""
        return self.max_p is not None or self.max_rate is not None

    @property
    def run_arguments(self) -> RunArguments:
        """The arguments of `samplers.estimate`."""
        from samplers.run import RunArguments

        confidence = RunArguments.confidence
        if self.max_p is not None and self.max_rate is not None:
            raise ValueError("Expected max_p or max_rate, not both: one run has one limit.")
        if self.max_p is not None and not 0.0 < self.max_p < 1.0:
            raise ValueError(f"Expected max_p above 0 and below 1, got {self.max_p!r}.")
        if self.max_rate is not None and not 0.0 < self.max_rate < math.inf:
            raise ValueError(f"Expected max_rate above 0, got {self.max_rate!r}.")
        if self.has_limit:
            one_sided = self.gate_confidence
            if not 0.5 < one_sided < 1.0:
                raise ValueError(f"Expected a one-sided confidence above 0.5 and below 1, got {one_sided!r}.")
            confidence = round(2.0 * one_sided - 1.0, 12)  # 0.9, where floating point has 0.8999999999999999
        return RunArguments(
            gamma=self.gamma,
            seed=self.seed,
            max_sim=self.max_sim,
            target_cov=self.target_cov,
            replicates=self.replicates,
            on_error=cast("OnError", self.on_error),
            confidence=confidence,
        )

    def check(self) -> Stepping:
        """Return the method, after a check of all that is known before the ego is loaded, which takes seconds."""
        from samplers.problem import check_whole

        _ = self.run_arguments
        if self.chunk is not None:
            check_whole("chunk", self.chunk, 1)
        method = find_method(self.method)
        find_scenario(self.env_id)
        return method


def find_method(name: str) -> Stepping:
    """Return a method with its defaults, by its name or as module:Class; the working directory is searched too."""
    from samplers.methods import get_method

    if ":" in name:
        import_object(name, f"the method {name!r}")
    return get_method(name)


@dataclass(frozen=True, kw_only=True)
class ExecutorOptions:
    """Where simulations are made; none of these options changes the answer."""

    workers: int | None = arg(None, "Processes that simulate; by default this one, or all cores of --executor.")
    executor: str | None = arg(None, "Where they are: local processes, or the machines of a Ray cluster.")
    address: str | None = arg(None, "Of the Ray cluster, or auto; by default one is started on this machine.")
    time_limit: float | None = arg(None, "Seconds for a chunk of simulations, after which its worker counts as hung.")
    memory_limit: float | None = arg(None, "GiB that the simulations of a worker process may take (Linux).")

    def make(self) -> Executor | None:
        """Return the executor; None for this process."""
        import samplers

        settings = {"--address": self.address, "--time-limit": self.time_limit, "--memory-limit": self.memory_limit}
        given = [name for name, value in settings.items() if value is not None]
        if self.executor not in (None, *EXECUTORS):
            raise ValueError(f"Expected executor to be {' or '.join(EXECUTORS)}, got {self.executor!r}.")
        if self.executor is None and self.workers is None:
            if given:
                raise ValueError(f"Expected {given[0]} together with --workers or --executor.")
            return None
        if self.address is not None and self.executor != "ray":
            raise ValueError("--address does not go with --executor local.")
        if self.memory_limit is not None and not 0.0 < self.memory_limit < float("inf"):
            raise ValueError(f"Expected --memory-limit to be a number of GiB above 0, got {self.memory_limit}.")
        memory = None if self.memory_limit is None else self.memory_limit * 2.0**30
        if self.executor == "ray":
            return samplers.executors.RayCluster(
                self.address, workers=self.workers, time_limit=self.time_limit, memory_limit=memory
            )
        return samplers.executors.LocalProcesses(self.workers, time_limit=self.time_limit, memory_limit=memory)


for _kind in (Question, ExecutorOptions):
    _lines = [f"    {each.name}: {each.metadata['help']}" for each in fields(_kind)]
    _kind.__doc__ = "\n".join([inspect.cleandoc(_kind.__doc__ or ""), "", "Attributes:", *_lines])


def option_name(argument: Field[Any]) -> str:
    """Return what an argument is called on the command line and in files."""
    return str(argument.metadata.get("option", argument.name))


def list_arguments() -> str:
    """Return a Markdown table of all arguments: key, type, default and what it does."""
    rows = ["| key | type | default | |", "|---|---|---|---|"]
    for each in (*fields(Question), *fields(ExecutorOptions)):
        kind = str(each.type).replace(" | ", " or ")
        default = "" if not isinstance(each.default, str | float | int) else f"`{each.default}`"
        rows.append(f"| `{option_name(each)}` | {kind} | {default} | {each.metadata['help']} |")
    return "\n".join(rows)


def read_question(values: Any) -> Question:
    """Return the question that a file has, without the fields that this version does not know."""
    if not isinstance(values, dict) or "env_id" not in values:
        raise BadInput(f"Expected a recorded question, an object with env_id, got {reprlib.repr(values)}.")
    known = {each.name: each for each in fields(Question) if each.name in values}
    check_types(known, values, " of the recorded question")
    return Question(**{name: values[name] for name in known})


def check_types(known: Mapping[str, Field[Any]], values: Mapping[str, Any], where: str = "") -> None:
    """Raise a BadInput if a value is not of the type of its argument; `where` stands behind its name."""
    for name, argument in known.items():
        kinds, value = [_KINDS[word] for word in str(argument.type).split(" | ")], values[name]
        types = tuple(kind for found, _ in kinds for kind in found)
        if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
            wanted = " or ".join(words for _, words in kinds)
            raise BadInput(f"Expected {name}{where} to be {wanted}, got {reprlib.repr(value)}.")


MAX_QUESTION_BYTES = 2**14
"""YAML is read at 40 kB/s."""
NOT_IN_FILES = ("trust",)
"""Whoever asks decides whether code runs, not a file."""
KEYS = {option_name(each): each for kind in (Question, ExecutorOptions) for each in fields(kind)}
"""Keys, with - or _ between words, and the fields that they stand for."""


def read_question_file(path: Path) -> dict[str, Any]:
    """Return the fields of `Question` and `ExecutorOptions` that a YAML file, which may be JSON, gives."""
    values: dict[str, Any] = {}
    for key, node in _read_nodes(path):
        name = key.replace("-", "_")
        if name in NOT_IN_FILES:
            raise BadInput(f"{str(path)!r} cannot say {key}: give --{key} on the command line.")
        if name not in KEYS:
            known = [each for each in KEYS if each not in NOT_IN_FILES]
            hint = did_you_mean(name, known)
            raise BadInput(f"{str(path)!r} has an unknown key {key!r}{hint}. It may have: {', '.join(known)}.")
        if name in values:
            raise BadInput(f"{str(path)!r} has the key {key!r} more than once.")
        values[name] = _read_value(node, KEYS[name])
    try:
        check_types({name: KEYS[name] for name in values}, values)
    except BadInput as error:
        raise BadInput(f"{str(path)!r}: {error}") from error
    return {KEYS[name].name: value for name, value in values.items()}


def read_mapping(path: Path) -> dict[str, Any]:
    """Return the mapping of any depth that a YAML file, which may be JSON, has."""
    import yaml

    node = _read_yaml(path)
    try:
        value = None if node is None else yaml.SafeLoader("").construct_document(node)
        json.dumps(value, allow_nan=False)  # as the answer repeats it
    except Exception as error:  # each tag, such as !!int, has errors of its own
        words = f"Expected {str(path)!r} to have texts, finite numbers and lists of them"
        raise BadInput(f"{words}: {' '.join(str(error).split())}.") from error
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise BadInput(f"Expected {str(path)!r} to have keys and values, as in vehicles_count: 20.")
    return value


def _read_yaml(path: Path) -> Any:
    """Return the node of a YAML file; no object is made of any."""
    import yaml

    try:
        text = read_text_file(path, MAX_QUESTION_BYTES)
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):  # a few bytes become gigabytes
            raise BadInput(f"{str(path)!r} repeats earlier values by *name: write them out.")
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except OSError as error:
        raise BadInput(f"Cannot read {str(path)!r}: {error.strerror}.") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise BadInput(f"{str(path)!r} is no YAML: {error}") from error
    except ValueError as error:
        raise BadInput(str(error)) from error


def _read_nodes(path: Path) -> list[tuple[str, Any]]:
    """Return the keys of a YAML file with their nodes."""
    import yaml

    node = _read_yaml(path)
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    if not pairs or not all(isinstance(key, yaml.ScalarNode) for key, _ in pairs):
        has = "has no keys: expected" if node is None else "cannot be used: expected"
        raise BadInput(f"{str(path)!r} {has} lines like gamma: 0.0.")
    for key, value in pairs:
        if not isinstance(value, yaml.ScalarNode):
            raise BadInput(f"Expected {key.value} in {str(path)!r} to be one value, as in gamma: 0.0.")
    return [(key.value, value) for key, value in pairs]


def read_whole(text: str) -> int:
    """Return a whole number, which may be written as 1e6."""
    try:
        return int(text)
    except ValueError:
        if (number := float(text)).is_integer():
            return int(number)
        raise


_READERS: dict[str, Callable[[str], Any]] = {
    "None": dict.fromkeys(("null", "~", "")).__getitem__,
    "bool": {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}.__getitem__,
    "int": read_whole,
    "float": float,
}


def _read_value(node: Any, argument: Field[Any]) -> Any:
    """Return what a node stands for by the type of its argument; its text where it does not fit."""
    if node.style is None and node.tag == "tag:yaml.org,2002:null":
        return None
    kinds = str(argument.type).split(" | ") if node.style is None else []  # what is in quotes is a text
    for kind in (kind for kind in _READERS if kind in kinds):
        with contextlib.suppress(KeyError, ValueError):
            return _READERS[kind](node.value.lower())
    return node.value


if __name__ == "__main__":
    print(list_arguments())
