"""Options that several commands of the command line take, each written once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from samplers import Executor


class NoiseChoice(str, Enum):
    """Names for the `noise` argument of `DrivingProblem`: True, "fixed" and False."""

    ON = "on"
    FIXED = "fixed"
    OFF = "off"

    @property
    def argument(self) -> bool | str:
        """The argument that the name stands for."""
        return {"on": True, "off": False}.get(self.value, self.value)

    @classmethod
    def of(cls, argument: bool | str) -> NoiseChoice:
        """Return the name of an argument."""
        return next(choice for choice in cls if choice.argument == argument)


def read_count(text: str) -> int:
    """Return the whole number that a text stands for, such as "10000" or "1e4".

    Raises:
        typer.BadParameter: If it is no whole number.
    """
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not number.is_integer():
        raise typer.BadParameter(f"expected a whole number, such as 10000 or 1e4, got {text!r}.")
    return int(number)


DEFAULT_BUDGET = "that of the method, 6,000 for two-stage"
LEADER_SCENARIOS = {"cut-in": "cut_in", "car-following": "car_following"}
"""Scenarios in which the ego gets a new leader; each is run beside the hard brake, and they count nothing twice."""


def read_environment(text: str | None) -> str | None:
    """Return the id of an environment with its namespace, where it was typed without."""
    from rare_envs.scenarios.registry import complete_id

    return None if text is None else complete_id(text)


EnvArgument = Annotated[
    str,
    typer.Argument(
        metavar="ENV",
        help="Environment, such as rare_envs/CutIn-v0.",
        callback=read_environment,
    ),
]
EgoArgument = Annotated[
    str,
    typer.Argument(metavar="EGO", help="An ego, as for estimate --ego."),
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace what the folder of --out has of an earlier run.")]
AlgoOption = Annotated[str | None, typer.Option(help="Algorithm of the .zip, if the file does not tell.")]
StatsOption = Annotated[
    str | None, typer.Option(help="File of the .zip's VecNormalize statistics; by default one is looked for beside it.")
]
DetailsOption = Annotated[
    bool,
    typer.Option("--details", help="Print all intervals, and all parameters of the most likely failure."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
SeedOption = Annotated[
    int, typer.Option(help="Seed; the same seed gives the same answer.", parser=read_count, metavar="INTEGER")
]
TrustOption = Annotated[
    bool,
    typer.Option(
        "--trust", help="Let code run: of the ego's .zip, though others can write to it; of a run from elsewhere."
    ),
]
ObservationOption = Annotated[
    str | None,
    typer.Option(
        help="Observation of the ego: features, lidar, kinematics, camera, speed, or camera+lidar; by default the "
        "one that the ego's space fits.",
    ),
]
ActionOption = Annotated[
    str | None,
    typer.Option(
        help="Actions of the ego: continuous or discrete, each tick, or HighwayEnv's meta, each second; by default "
        "those that its space fits.",
    ),
]
DeviceOption = Annotated[
    str,
    typer.Option(
        help="Where torch simulates: cpu, or a GPU (cuda, cuda:1), which leaves numba out: docs/speed.md.",
    ),
]
EnsembleRunOption = Annotated[
    bool,
    typer.Option(
        "--ensemble-run/--no-ensemble-run",
        help="Where the failures found do not reach the refits of the base, simulate up to as much again under these.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class ScenarioOptions:
    """Options of each command that drives an ego: the scenario, and the interface of the ego."""

    base: Annotated[str | None, typer.Option(help="Base distribution: a name or a JSON file.")] = None
    drivers: Annotated[
        str | None,
        typer.Option(
            help="Of the vehicles around: mgail, mgail?rules=0, gail, idm, idm+mobil or a file.",
        ),
    ] = None
    observation: ObservationOption = None
    action: ActionOption = None
    horizon: Annotated[float | None, typer.Option(help="Length of an episode in seconds.")] = None

    def arguments(self) -> dict[str, Any]:
        """Return the options as keyword arguments of `Question` and of `gym.make`."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # a field by its name
        return {name: value.argument if isinstance(value, NoiseChoice) else value for name, value in values.items()}


@dataclass(frozen=True, kw_only=True)
class WorldOptions(ScenarioOptions):
    """Options of the world: noise and weather."""

    noise: Annotated[
        NoiseChoice, typer.Option("--noise", help="The drivers' noise: part of x, one fixed sequence, none.")
    ] = NoiseChoice.ON
    weather: Annotated[bool, typer.Option("--weather", help="Make weather and the camera's noise parameters.")] = False


@dataclass(frozen=True, kw_only=True)
class QuestionOptions(WorldOptions):
    """Options of a question: method, measure, threshold."""

    method: Annotated[str, typer.Option(help="Estimation method; see rare-envs list methods.")] = "auto"
    measure: Annotated[
        str,
        typer.Option(
            help="Safety measure f, small is dangerous: a name, module:function or stl:FORMULA.",
        ),
    ] = "ttc"
    gamma: Annotated[float, typer.Option(help="Threshold: P[f <= gamma]; 0 counts collisions.")] = 0.0
    seed: SeedOption = 0
    collisions: Annotated[
        str,
        typer.Option(help="Which count: ego, or any, between others too."),
    ] = "ego"
    device: DeviceOption = "cpu"
    ensemble_run: EnsembleRunOption = True
    trust: TrustOption = False


@dataclass(frozen=True, kw_only=True)
class EstimateOptions(QuestionOptions):
    """Options of `estimate` alone."""

    ego: Annotated[
        str,
        typer.Option(
            help="A name, a .zip or .onnx, module:function, tcp://..., noisy:EGO; see rare-envs list egos.",
        ),
    ] = "idm"
    algo: AlgoOption = None
    stats: StatsOption = None
    ensemble: Annotated[
        bool, typer.Option("--ensemble", help="Take the mixture of the refits of the base: p for the next event.")
    ] = False
    also_under: Annotated[
        str | None, typer.Option(help="State p under these bases too, by the same simulations: us101-closing,i80.")
    ] = None
    max_sim: Annotated[
        int | None,
        typer.Option(
            help="Largest number of simulations.", parser=read_count, metavar="INTEGER", show_default=DEFAULT_BUDGET
        ),
    ] = None
    target_cov: Annotated[float | None, typer.Option(help="Stop at this coefficient of variation.")] = None
    replicates: Annotated[int, typer.Option(help="Independent runs, combined by their mean.")] = 1
    on_error: Annotated[
        str,
        typer.Option(
            help="Where the ego fails twice: raise, failure or bound.",
        ),
    ] = "raise"
    chunk: Annotated[
        int | None,
        typer.Option(help="Simulations at once, few for a slow ego; with --workers 256, and 4,096 of rules."),
    ] = None
    core: Annotated[
        str,
        typer.Option(
            help="What simulates: torch, numba (compiled, where it can be had: docs/speed.md), or auto.",
        ),
    ] = "auto"
    sensitivity: Annotated[
        bool,
        typer.Option("--sensitivity", help="Show what p is sensitive to: parameters of traffic and of its model."),
    ] = False
    max_p: Annotated[
        float | None,
        typer.Option(help="Limit of p: the exit code is 0 if it passes, 4 if it fails, 5 if that is undecided."),
    ] = None
    gate_confidence: Annotated[
        float, typer.Option("--confidence", help="One-sided, of the comparison with --max-p.")
    ] = 0.95
    given_base: Annotated[
        bool, typer.Option("--given-base", help="Compare with --max-p as if the base distribution were the true one.")
    ] = False


@dataclass(frozen=True, kw_only=True)
class RiskOptions:
    """Options of `risk`: which scenarios and sites, and how the ego is driven."""

    leaders: Annotated[
        str,
        typer.Option(
            "--with",
            help="Scenario of new leaders beside hard brake: cut-in or car-following.",
        ),
    ] = "cut-in"
    sites: Annotated[
        str,
        typer.Option(help="Site of the bases, us101 or i80; both, joined by a comma, for the spread between sites."),
    ] = "us101"
    base: Annotated[
        list[str] | None, typer.Option(help="SCENARIO=NAME or FILE, in place of the site's base; may be repeated.")
    ] = None
    method: Annotated[str, typer.Option(help="Estimation method; see rare-envs list methods.")] = "auto"
    max_sim: Annotated[
        int | None,
        typer.Option(
            help="Largest number of simulations of each scenario.",
            parser=read_count,
            metavar="INTEGER",
            show_default=DEFAULT_BUDGET,
        ),
    ] = None
    ensemble_run: EnsembleRunOption = True
    device: DeviceOption = "cpu"
    seed: SeedOption = 0
    algo: AlgoOption = None
    stats: StatsOption = None
    trust: TrustOption = False
    observation: ObservationOption = None
    action: ActionOption = None

    def arguments(self) -> dict[str, Any]:
        """Return the options as keyword arguments of `rare_envs.risk`.

        Raises:
            ValueError: A base has another form.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        pairs = [each.partition("=") for each in values.pop("base") or []]
        for scenario, _, base in pairs:
            if not scenario or not base:
                raise ValueError(f"Expected --base SCENARIO=NAME, such as cut_in=i80, got {scenario!r} alone.")
        names = [scenario for scenario, _, _ in pairs]
        for scenario in names:
            if names.count(scenario) > 1:
                raise ValueError(
                    f"Expected one --base for each scenario, got {names.count(scenario)} for {scenario!r}."
                )
        leaders = str(values.pop("leaders"))
        if leaders not in LEADER_SCENARIOS:
            raise ValueError(
                f"Expected --with {' or --with '.join(LEADER_SCENARIOS)}, got {leaders!r}: the sum is that of the hard "
                "brake and one scenario of new leaders, whose events were counted and are not in it twice."
            )
        scenarios = (LEADER_SCENARIOS[leaders], "hard_brake")
        sites = [site.strip() for site in values.pop("sites").split(",") if site.strip()]
        return {**values, "scenarios": scenarios, "sites": sites, "bases": {name: base for name, _, base in pairs}}


GIB = 2.0**30


class ExecutorKind(str, Enum):
    """Names of executors."""

    LOCAL = "local"
    RAY = "ray"


@dataclass(frozen=True, kw_only=True)
class ExecutorOptions:
    """Where simulations are made; none of these options changes the answer."""

    workers: Annotated[
        int | None, typer.Option(help="Processes that simulate; by default this one, or all cores of --executor.")
    ] = None
    executor: Annotated[
        ExecutorKind | None, typer.Option(help="Where they are: local processes, or the machines of a Ray cluster.")
    ] = None
    address: Annotated[
        str | None, typer.Option(help="Of the Ray cluster, or auto; by default one is started on this machine.")
    ] = None
    time_limit: Annotated[
        float | None, typer.Option(help="Seconds for a chunk of simulations, after which its worker counts as hung.")
    ] = None
    memory_limit: Annotated[
        float | None, typer.Option(help="GiB that the simulations of a worker process may take (Linux).")
    ] = None

    def fill(self, others: Mapping[str, Any], typed: set[str]) -> ExecutorOptions:
        """Return these options with those of a file in place of what was not typed.

        Args:
            others: Options of the file, by name.
            typed: Names of the options that were typed.

        Raises:
            ValueError: If the file names an executor that there is not.
        """
        values = {name: value for name, value in others.items() if name not in typed and value is not None}
        kinds = [kind.value for kind in ExecutorKind]
        if values.get("executor", kinds[0]) not in kinds:
            raise ValueError(
                f"In the file of --config: expected executor to be {' or '.join(kinds)}, got {values['executor']!r}."
            )
        if "executor" in values:
            values["executor"] = ExecutorKind(values["executor"])
        return replace(self, **values)

    def make(self) -> Executor | None:
        """Return the executor; None for this process.

        Raises:
            ValueError: If an option is out of range, or does not go with the executor.
        """
        import samplers

        settings = {"--address": self.address, "--time-limit": self.time_limit, "--memory-limit": self.memory_limit}
        given = [name for name, value in settings.items() if value is not None]
        if self.executor is None and self.workers is None:
            if given:
                raise ValueError(f"Expected {given[0]} together with --workers or --executor.")
            return None
        if self.address is not None and self.executor is not ExecutorKind.RAY:
            raise ValueError("--address does not go with --executor local.")
        if self.memory_limit is not None and not 0.0 < self.memory_limit < float("inf"):
            raise ValueError(f"Expected --memory-limit to be a number of GiB above 0, got {self.memory_limit}.")
        memory = None if self.memory_limit is None else self.memory_limit * GIB
        if self.executor is ExecutorKind.RAY:
            return samplers.RayCluster(self.address, self.workers, self.time_limit, memory_limit=memory)
        return samplers.LocalProcesses(self.workers, self.time_limit, memory)
