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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
    """Make the folder of a file before the work, as `output_folder` does, and say of an error which file it is.

    None where there is none to write.
    """
    refuse_existing(force, path)
    with contextlib.nullcontext() if path is None else output_folder(path.parent, path.name):
        try:
            yield
        except OSError as error:
            raise BadInput(f"Cannot write {str(path)!r}: {error.strerror or error}.") from error


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

    env_id: str = field(
        metadata={"help": "Scenario: CutIn, cut-in and rare_envs/CutIn-v1 are the same.", "option": "env"}
    )
    base: str | None = arg(None, "Traffic model: a name of rare-envs list SCENARIO, or a JSON file of rare-envs fit.")
    drivers: str | None = arg(
        None, "Driver model of surrounding vehicles: mgail, gail, idm, idm+mobil, a file, or cutter=POLICY.zip."
    )
    observation: str | None = arg(
        None,
        "Observation of the ego: features, lidar, kinematics, camera, speed or camera+lidar; by default the one that "
        "fits its observation space.",
    )
    action: str | None = arg(
        None,
        "Actions of the ego: continuous or discrete (each tick), or HighwayEnv's meta (each second); by default those "
        "that fit its action space.",
    )
    horizon: float | None = arg(None, "Length of an episode in seconds.")
    noise: bool | str = arg(
        True, "Noise of the drivers: on (part of the scenario), fixed (the same in every scenario) or off."
    )
    weather: bool = arg(False, "Make weather and the noise of the camera part of the scenario.")
    method: str = arg("auto", "Estimation method (see rare-envs list methods), or module:Class.")
    measure: str = arg("ttc", "Safety measure f, small is dangerous: a name, module:function or stl:FORMULA.")
    gamma: float = arg(0.0, "Threshold: a failure is f <= gamma; 0 counts collisions.")
    seed: int = arg(0, "Random seed; the same seed gives the same answer.", count=True)
    collisions: str = arg("ego", "Collisions that count: ego (the ego's) or any.")
    device: str = arg("cpu", "Device that simulates: cpu, or a GPU (cuda, cuda:1), which needs core torch or auto.")
    ensemble_run: bool = arg(
        True, "Spend up to the same budget again to cover the uncertainty of the traffic model, if it is needed."
    )
    trust: bool = arg(
        False, "Allow a policy file that others can write to, or a run made elsewhere, to execute code and to connect."
    )
    ego: str = arg(
        "idm", "Policy under test: a name, a .zip or .onnx file, module:function or tcp://HOST:PORT; list egos has all."
    )
    algo: str | None = arg(None, "Algorithm of the policy file, if the file does not tell it.")
    stats: str | None = arg(
        None, "File of the policy's VecNormalize statistics; by default it is looked for next to the policy file."
    )
    ensemble: bool = arg(False, "Use the mixture of the refits of the traffic model: p for the next event.")
    also_under: str | None = arg(
        None, "Estimate p under these traffic models too, from the same simulations: us101-closing,i80."
    )
    max_sim: int | None = arg(
        None,
        "Largest number of simulations.",
        count=True,
        show_default="that of the method, 6,000 for two-stage",
    )
    target_cov: float | None = arg(None, "Relative standard error at which to stop: 0.1 is 10 %.")
    replicates: int = arg(1, "Number of independent runs, combined by their mean.")
    on_error: str = arg("raise", "If the ego errors twice on a scenario: raise, or count it as failure or bound.")
    chunk: int | None = arg(
        None, "Simulations per batch, few for a slow ego; by default 256 with --workers, 4,096 for egos by rules."
    )
    core: str = arg("auto", "Simulator core: torch, numba (compiled) or auto.")
    sensitivity: bool = arg(False, "Show to which parameters of the traffic and of its model p is sensitive.")
    max_p: float | None = arg(None, "Limit of p: exit code 0 if p is below it, 4 if above, 5 if undecided.")
    max_rate: float | None = arg(
        None, "Limit of the collisions per million km: exit code 0 if the rate is below it, 4 if above, 5 if undecided."
    )
    max_ratio: float | None = arg(
        None, "Limit of p_B / p_A, by how much B may be worse: exit code 0 if it is below, 4 if above, 5 if undecided."
    )
    confidence: float = arg(0.95, "Confidence level of the interval; with a limit, that of its one-sided test.")
    assume_traffic: bool = arg(False, "Test the limit as if the traffic model were exact: a test of the ego alone.")

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
        return any(limit is not None for limit in (self.max_p, self.max_rate, self.max_ratio))

    @property
    def run_arguments(self) -> RunArguments:
        """The arguments of `samplers.estimate`."""
        from samplers.run import RunArguments

        if self.max_p is not None and self.max_rate is not None:
            raise ValueError("Expected max_p or max_rate, not both: one run has one limit.")
        if self.max_p is not None and not 0.0 < self.max_p < 1.0:
            raise ValueError(f"Expected max_p above 0 and below 1, got {self.max_p!r}.")
        if self.target_cov is not None and 1.0 <= self.target_cov < 100.0:
            wanted = f"{self.target_cov:g} % is {self.target_cov / 100:g}"
            raise ValueError(f"Expected target_cov below 1, got {self.target_cov:g}: {wanted}.")
        for name in ("max_rate", "max_ratio"):
            if (limit := getattr(self, name)) is not None and not 0.0 < limit < math.inf:
                raise ValueError(f"Expected {name} above 0, got {limit!r}.")
        if self.assume_traffic and not self.has_limit:
            raise ValueError("Expected assume_traffic together with a limit; see Gate in --help.")
        confidence = self.confidence
        if not 0.0 < confidence < 1.0:
            hint = f": {confidence:g} % is {confidence / 100:g}" if 1.0 < confidence < 100.0 else ""
            raise ValueError(f"Expected confidence above 0 and below 1, got {confidence!r}{hint}.")
        if self.has_limit:
            if not 0.5 < confidence:
                raise ValueError(f"Expected a one-sided confidence above 0.5 and below 1, got {confidence!r}.")
            confidence = round(2.0 * confidence - 1.0, 12)  # 0.9, where floating point has 0.8999999999999999
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

    workers: int | None = arg(None, "Number of processes that simulate; the answer does not depend on it.")
    executor: str | None = arg(None, "Where the workers are: local (processes) or ray (machines of a Ray cluster).")
    address: str | None = arg(None, "Address of the Ray cluster, or auto; by default one is started on this machine.")
    time_limit: float | None = arg(None, "Seconds per batch, after which a worker counts as hung and is restarted.")
    memory_limit: float | None = arg(None, "Memory limit of each worker in GiB (Linux).")

    def make(self) -> Executor | None:
        """Return the executor; None for this process."""
        import samplers

        settings = {"address": self.address, "time_limit": self.time_limit, "memory_limit": self.memory_limit}
        given = [name for name, value in settings.items() if value is not None]
        if self.executor not in (None, *EXECUTORS):
            raise ValueError(f"Expected executor to be {' or '.join(EXECUTORS)}, got {self.executor!r}.")
        if self.executor is None and self.workers is None:
            if given:
                raise ValueError(f"Expected {given[0]} together with workers or executor.")
            return None
        if self.address is not None and self.executor != "ray":
            raise ValueError("Expected address together with executor ray.")
        if self.memory_limit is not None and not 0.0 < self.memory_limit < float("inf"):
            raise ValueError(f"Expected memory_limit to be a number of GiB above 0, got {self.memory_limit}.")
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


def read_question_file(path: Path, names: Iterable[str] = KEYS, texts: Sequence[str] = ()) -> dict[str, Any]:
    """Return what a YAML file, which may be JSON, gives: fields of `Question` and `ExecutorOptions`, and texts.

    `names` are the keys of the fields that it may give, and `texts` those of further options.
    """
    values: dict[str, Any] = {}
    known = [name for name in (*texts, *names) if name not in NOT_IN_FILES]
    for key, node in _read_nodes(path):
        name = key.replace("-", "_")
        if name in NOT_IN_FILES:
            raise BadInput(f"{str(path)!r} cannot say {key}: give --{key} on the command line.")
        if name not in known:
            why = f"the key {key!r}, which this command does not use" if name in KEYS else f"an unknown key {key!r}"
            raise BadInput(f"{str(path)!r} has {why}{did_you_mean(name, known)}. It may have: {', '.join(known)}.")
        if name in values:
            raise BadInput(f"{str(path)!r} has the key {key!r} more than once.")
        values[name] = node.value if name in texts else _read_value(node, KEYS[name])
    try:
        check_types({name: KEYS[name] for name in values if name not in texts}, values)
    except BadInput as error:
        raise BadInput(f"{str(path)!r}: {error}") from error
    return {name if name in texts else KEYS[name].name: value for name, value in values.items()}


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
