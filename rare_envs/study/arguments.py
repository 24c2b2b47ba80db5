"""Arguments of an evaluation, each written once: options, keys of YAML files and study.json follow from these fields.

Importing this takes milliseconds, so that the command line starts without torch.
"""

from __future__ import annotations

import inspect
import reprlib
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from typing import TYPE_CHECKING, Any, cast

from rare_envs.scenarios.registry import find_scenario, split_layout
from rare_envs.study.errors import BadInput

if TYPE_CHECKING:
    from samplers import Executor, RunArguments, Stepping
    from samplers.validation import OnError

GIB = 2.0**30
EXECUTORS = ("local", "ray")
_JSON_TYPES: dict[str, tuple[type, ...]] = {
    "str": (str,),
    "int": (int,),
    "float": (int, float),
    "bool": (bool,),
    "None": (type(None),),
}
"""Names in the annotations of fields to types in JSON."""
_TYPE_WORDS = {"str": "a text", "int": "a whole number", "float": "a number", "bool": "true or false", "None": "null"}
"""What the messages call them."""


def argument(default: Any, help: str, **about: Any) -> Any:
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
    base: str | None = argument(None, "Base distribution: a name or a JSON file.")
    drivers: str | None = argument(
        None, "Of the vehicles around: mgail, mgail?rules=0, gail, idm, idm+mobil or a file."
    )
    observation: str | None = argument(
        None,
        "Observation of the ego: features, lidar, kinematics, camera, speed, or camera+lidar; by default the "
        "one that the ego's space fits.",
    )
    action: str | None = argument(
        None,
        "Actions of the ego: continuous or discrete, each tick, or HighwayEnv's meta, each second; by default "
        "those that its space fits.",
    )
    horizon: float | None = argument(None, "Length of an episode in seconds.")
    noise: bool | str = argument(True, "The drivers' noise: part of x, one fixed sequence, none.")
    weather: bool = argument(False, "Make weather and the camera's noise parameters.")
    method: str = argument("auto", "Estimation method; see rare-envs list methods.")
    measure: str = argument("ttc", "Safety measure f, small is dangerous: a name, module:function or stl:FORMULA.")
    gamma: float = argument(0.0, "Threshold: P[f <= gamma]; 0 counts collisions.")
    seed: int = argument(0, "Seed; the same seed gives the same answer.", count=True)
    collisions: str = argument("ego", "Which count: ego, or any, between others too.")
    device: str = argument(
        "cpu", "Where torch simulates: cpu, or a GPU (cuda, cuda:1), which leaves numba out: docs/executors.md."
    )
    ensemble_run: bool = argument(
        True,
        "Where the failures found do not reach the refits of the base, simulate up to as much again under these.",
        flags="--ensemble-run/--no-ensemble-run",
    )
    trust: bool = argument(
        False, "Let code run: of the ego's .zip, though others can write to it; of a run from elsewhere."
    )
    ego: str = argument(
        "idm", "A name, a .zip or .onnx, module:function, tcp://..., noisy:EGO; see rare-envs list egos."
    )
    algo: str | None = argument(None, "Algorithm of the .zip, if the file does not tell.")
    stats: str | None = argument(
        None, "File of the .zip's VecNormalize statistics; by default one is looked for beside it."
    )
    ensemble: bool = argument(False, "Take the mixture of the refits of the base: p for the next event.")
    also_under: str | None = argument(
        None, "State p under these bases too, by the same simulations: us101-closing,i80."
    )
    max_sim: int | None = argument(
        None, "Largest number of simulations.", count=True, show_default="that of the method, 6,000 for two-stage"
    )
    target_cov: float | None = argument(None, "Stop at this coefficient of variation.")
    replicates: int = argument(1, "Independent runs, combined by their mean.")
    on_error: str = argument("raise", "Where the ego fails twice: raise, failure or bound.")
    chunk: int | None = argument(
        None, "Simulations at once, few for a slow ego; with --workers 256, and 4,096 of rules."
    )
    core: str = argument(
        "auto", "What simulates: torch, numba (compiled, where it can be had: docs/executors.md), or auto."
    )
    sensitivity: bool = argument(False, "Show what p is sensitive to: parameters of traffic and of its model.")
    max_p: float | None = argument(
        None, "Limit of p: the exit code is 0 if it passes, 4 if it fails, 5 if that is undecided."
    )
    gate_confidence: float = argument(0.95, "One-sided, of the comparison with --max-p.", option="confidence")
    given_base: bool = argument(False, "Compare with --max-p as if the base distribution were the true one.")

    def __post_init__(self) -> None:
        """Take an id with HighwayEnv's layout as that of the scenario, with the observation and actions it means."""
        env_id, layout = split_layout(self.env_id)
        object.__setattr__(self, "env_id", env_id)
        if layout:
            object.__setattr__(self, "observation", self.observation or layout["observation"])
            object.__setattr__(self, "action", self.action or layout["action"])

    @property
    def run_arguments(self) -> RunArguments:
        """The arguments of `samplers.estimate`."""
        from samplers.run import RunArguments

        return RunArguments(
            gamma=self.gamma,
            seed=self.seed,
            max_sim=self.max_sim,
            target_cov=self.target_cov,
            replicates=self.replicates,
            on_error=cast("OnError", self.on_error),
            confidence=RunArguments.confidence if self.max_p is None else self._two_sided_confidence,
        )

    @property
    def _two_sided_confidence(self) -> float:
        """Coverage of an interval whose ends are at `gate_confidence` each."""
        if not 0.0 < cast(float, self.max_p) < 1.0:
            raise ValueError(f"Expected max_p above 0 and below 1, got {self.max_p!r}.")
        if not 0.5 < self.gate_confidence < 1.0:
            raise ValueError(f"Expected a one-sided confidence above 0.5 and below 1, got {self.gate_confidence!r}.")
        return round(2.0 * self.gate_confidence - 1.0, 12)  # 0.9, where floating point has 0.8999999999999999

    def check(self) -> Stepping:
        """Return the method, after a check of all that is known before the ego is loaded, which takes seconds."""
        import samplers
        from samplers.validation import check_whole

        _ = self.run_arguments
        if self.chunk is not None:
            check_whole("chunk", self.chunk, 1)
        method = samplers.get_method(self.method)
        find_scenario(self.env_id)
        return method


@dataclass(frozen=True, kw_only=True)
class ExecutorOptions:
    """Where simulations are made; none of these options changes the answer."""

    workers: int | None = argument(None, "Processes that simulate; by default this one, or all cores of --executor.")
    executor: str | None = argument(None, "Where they are: local processes, or the machines of a Ray cluster.")
    address: str | None = argument(None, "Of the Ray cluster, or auto; by default one is started on this machine.")
    time_limit: float | None = argument(
        None, "Seconds for a chunk of simulations, after which its worker counts as hung."
    )
    memory_limit: float | None = argument(None, "GiB that the simulations of a worker process may take (Linux).")

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
        memory = None if self.memory_limit is None else self.memory_limit * GIB
        if self.executor == "ray":
            return samplers.RayCluster(self.address, self.workers, self.time_limit, memory_limit=memory)
        return samplers.LocalProcesses(self.workers, self.time_limit, memory)


for _kind in (Question, ExecutorOptions):
    _lines = [f"    {each.name}: {each.metadata['help']}" for each in fields(_kind)]
    _kind.__doc__ = "\n".join([inspect.cleandoc(_kind.__doc__ or ""), "", "Attributes:", *_lines])


def option_name(argument: Field[Any]) -> str:
    """Return what an argument is called on the command line and in files."""
    return str(argument.metadata.get("option", argument.name))


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
        words, value = str(argument.type).split(" | "), values[name]
        types = tuple(kind for word in words for kind in _JSON_TYPES[word])
        if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
            wanted = " or ".join(_TYPE_WORDS[word] for word in words)
            raise BadInput(f"Expected {name}{where} to be {wanted}, got {reprlib.repr(value)}.")
