"""Evaluation of an ego: the question, checked in full before the first simulation, and the report."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

import agents
import rare_envs
import samplers
from agents.sb3.saved_ego import SavedEgo
from rare_envs.egos.errors import EgoGone
from rare_envs.egos.faults import Fault, FaultTolerant
from rare_envs.problem import AmbiguousActions
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.rollout import drive
from rare_envs.study.crash_kinds import CrashKinds, classify_failures
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.study.journal import Journal, JournaledProblem
from samplers.errors import OnError
from samplers.execution.arguments import RunArguments


@dataclass(frozen=True, kw_only=True)
class Question:
    """All inputs of an evaluation: the same question gives the same answer.

    Attributes:
        env_id: Environment, such as "rare_envs/CutIn-v0".
        ego: "idm", a learned driver ("mgail", "gail", "bc" or its file), a path to a Stable-Baselines3 `.zip`, or
            `module:function`.
        algo: Algorithm of a `.zip`; recognised from the file when None.
        trust: Let the ego's `.zip` run code when it is loaded, as `agents.load_ego` explains.
        method: Name of a method in `samplers.METHODS`.
        base: Name of a base distribution or path to a JSON file; the scenario's default when None.
        measure: Safety measure f: a name, "module:name" or "stl:FORMULA".
        gamma: Threshold; the answer is P[f(X) <= gamma].
        seed: Seed of everything that is drawn.
        max_sim: Largest number of simulations, or None.
        target_cov: Stop when the coefficient of variation is this small, or None.
        replicates: Number of independent runs, combined by their mean.
        noise: Noise of the drivers, as in `DrivingProblem`: True, "fixed" or False.
        drivers: Of the vehicles around the ego: the name of installed ones or a file; the scenario's default when None.
        horizon: Length of an episode [s]; the scenario's when None.
        observation: Observation of the ego: "features", "lidar", "kinematics", "camera" or "speed"; several joined by
            "+"; None for the one that it declares, else "features".
        action: Actions of a policy: "continuous" or "meta".
        collisions: Which collisions count: those of the "ego", or "any", those between two other vehicles too.
        weather: Whether weather and the camera's noise are parameters.
        on_error: Treatment of scenarios on which the ego fails twice: "raise" ends the run, "failure" counts them as
            failing, "bound" as failing in p and the upper end of the interval, but not in the lower end.

    Example:
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", ego="idm", gamma=3.0, seed=1)
        >>> question.run_arguments.gamma, question.method
        (3.0, 'two-stage')
    """

    env_id: str
    ego: str = "idm"
    algo: str | None = None
    trust: bool = False
    method: str = "two-stage"
    base: str | None = None
    measure: str = "ttc"
    gamma: float = RunArguments.gamma
    seed: int = 0
    max_sim: int | None = RunArguments.max_sim
    target_cov: float | None = RunArguments.target_cov
    replicates: int = RunArguments.replicates
    noise: bool | str = True
    drivers: str | None = None
    horizon: float | None = None
    observation: str | None = None
    action: str = "continuous"
    on_error: str = RunArguments.on_error
    collisions: str = "ego"
    weather: bool = False

    @property
    def run_arguments(self) -> RunArguments:
        """The arguments of `samplers.estimate`.

        Raises:
            ValueError: If one of them is out of range.
        """
        return RunArguments(
            gamma=self.gamma,
            seed=self.seed,
            max_sim=self.max_sim,
            target_cov=self.target_cov,
            replicates=self.replicates,
            on_error=cast(OnError, self.on_error),
        )


@dataclass(frozen=True)
class Study:
    """A question with everything that it names, loaded and checked.

    Example:
        >>> study = prepare(Question(env_id="rare_envs/CarFollowing-v0", method="mc"))
        >>> study.problem.space.names, study.method.name
        (('ego_speed', 'lead_speed', 'gap'), 'mc')
    """

    question: Question
    problem: rare_envs.DrivingProblem
    method: samplers.Stepping


@dataclass(frozen=True)
class Report:
    """Answer to a question.

    Attributes:
        study: The question and what it names.
        estimate: The estimate of the method.
        seconds: Wall time of the estimation [s].
        faults: Scenarios on which the ego failed twice.
        n_retried: Simulations that were repeated to find them; not in n_sim.
        kinds: Crashes in which the failures ended.

    Example:
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", gamma=3.0, horizon=3.0, method="mc", max_sim=1000)
        >>> report = run(prepare(question))
        >>> answer = report.to_dict()
        >>> answer["n_failures"], answer["doubtful"], answer["failures"][0]["crash"]
        (21, False, None)
    """

    study: Study
    estimate: samplers.Estimate
    seconds: float
    faults: tuple[Fault, ...] = ()
    kinds: CrashKinds = field(default_factory=CrashKinds)
    n_retried: int = 0

    @property
    def doubtful(self) -> bool:
        """Whether the method itself warns that the number may be wrong."""
        return bool(self.estimate.warnings)

    @property
    def crashes(self) -> tuple[dict[str, Any] | None, ...]:
        """The crash of each listed failure, see `rare_envs.traffic.crash.describe_crash`; None where nobody crashed."""
        return self.kinds.listed or (None,) * len(self.estimate.failures)

    @property
    def notes(self) -> tuple[str, ...]:
        """Options that make no difference here, notes of the problem, and what is not known."""
        unknown = (f"kinds of crash are not known: {self.kinds.unknown}",) if self.kinds.unknown else ()
        return (*self._unused_options, *self.study.problem.notes, *unknown)

    @property
    def _unused_options(self) -> tuple[str, ...]:
        world, noise = self.study.problem.world, self.study.question.noise
        if noise is True or world.sensing.weather or (world.background is not None and world.background.noisy):
            return ()
        word = "off" if noise is False else noise
        return (f"--noise {word} changes nothing: nobody in this traffic drives with noise (see --drivers)",)

    @property
    def vec_normalize(self) -> str | None:
        """File of the `VecNormalize` statistics that were applied to a saved ego's observations, if there was one."""
        ego = self.study.problem.ego
        return str(ego.statistics_path) if isinstance(ego, SavedEgo) and ego.statistics_path else None

    def to_dict(self, top: int = 10) -> dict[str, Any]:
        """Return the report as JSON-ready values: question, estimate and the `top` most likely failures."""
        failures = self.estimate.failures
        space = self.study.problem.space
        ranked = [
            {
                "parameters": self._parameters(failure.x),
                "f": failure.f if math.isfinite(failure.f) else None,
                "log_p0": failure.log_p0,
                "crash": crash,
            }
            for failure, crash in itertools.islice(zip(failures, self.crashes, strict=True), top)
        ]
        return {
            **self.estimate.to_dict(),
            "question": asdict(self.study.question),
            "doubtful": self.doubtful,
            "notes": self.notes,
            "vec_normalize": self.vec_normalize,
            "seconds": self.seconds,
            "n_failures": failures.total,
            "kinds": {kind: share.to_dict() for kind, share in self.kinds.shares.items()},
            "failures": ranked,
            "n_faults": len(self.faults),
            "n_retried": self.n_retried,
            "faults": [
                {"parameters": self._parameters(fault.x), "reason": fault.reason} for fault in self.faults[:top]
            ],
            "units": dict(zip(space.names, space.units, strict=True)),
            "version": rare_envs.__version__,
        }

    def _parameters(self, x: NDArray[np.float64]) -> dict[str, Any]:
        named = self.study.problem.space.named(x)
        return {name: np.asarray(value).tolist() for name, value in named.items()}


def prepare(question: Question) -> Study:
    """Check a question and load what it names; nothing is simulated.

    Args:
        question: The question.

    Returns:
        The study, ready to run.

    Raises:
        BadInput: Something in the question cannot be used.

    Example:
        >>> prepare(Question(env_id="rare_envs/CutIn-v0", seed=-1))
        Traceback (most recent call last):
            ...
        rare_envs.study.errors.BadInput: Expected seed to be a whole number of at least 0, got -1.
    """
    with as_bad_input(ValueError, OSError):
        question.run_arguments  # noqa: B018  (checks them)
        method = samplers.get_method(question.method)
        find_scenario(question.env_id)  # before the ego, which takes seconds to load
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AmbiguousActions)  # it is among the notes
            problem = rare_envs.DrivingProblem(
                question.env_id,
                ego=ego,
                measure=question.measure,
                base=question.base,
                noise=question.noise,
                drivers=question.drivers,
                horizon=question.horizon,
                collisions=question.collisions,
                observation=question.observation,
                weather=question.weather,
                action=question.action,
            )
    _try_ego(problem)
    return Study(replace(question, observation=problem.world.sensing.observation), problem, method)


@torch.inference_mode()
def _try_ego(problem: rare_envs.DrivingProblem) -> None:
    """Query the ego twice with ordinary traffic at time 0.

    This finds a broken ego before the simulations, and one whose answers vary from run to run.

    Raises:
        BadInput: It raised, or its actions are not actions.
    """
    x = torch.from_numpy(problem.space.sample(2, np.random.default_rng(0))).float()
    try:
        first, again = (list(itertools.islice(drive(problem.world, problem.driver, x), 2))[1] for _ in range(2))
        same = torch.equal(first.state.speed, again.state.speed) and torch.equal(
            first.state.heading, again.state.heading
        )
        problem.varies = problem.varies or not same
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
        words = "" if isinstance(error, SystemExit) else str(error)
        raise BadInput(f"The ego fails on its first observation: {words or repr(error)}") from error


def run(
    study: Study,
    progress: bool | Callable[[samplers.Progress], None] = False,
    journal: Journal | None = None,
) -> Report:
    """Answer a question.

    Args:
        study: From `prepare`.
        progress: True for a bar on standard error, or a function, as in `samplers.estimate`.
        journal: Keeps finished simulations, and has those of an interrupted run.

    Returns:
        The report.

    Raises:
        BadInput: The ego failed on some x, or is gone.

    Example:
        How often does the rule-based ego come within 3 s of a collision in the first 3 s?

        >>> question = Question(env_id="rare_envs/CarFollowing-v0", gamma=3.0, horizon=3.0, method="mc", max_sim=1000)
        >>> report = run(prepare(question))
        >>> report.estimate.p, report.estimate.n_sim
        (0.021, 1000)
    """
    question, start = study.question, time.perf_counter()
    problem = FaultTolerant(study.problem, question.on_error)
    try:
        estimate = samplers.estimate(
            problem if journal is None else JournaledProblem(problem, journal, study.problem.tile),
            study.method,
            **asdict(question.run_arguments),
            progress=progress,
        )
    except EgoGone as error:
        raise BadInput(
            f"{error}{'' if journal else ' With --out finished simulations would have been kept.'}"
        ) from error
    except ValueError as error:
        raise BadInput(error) from error
    seconds = time.perf_counter() - start
    kinds = classify_failures(study.problem, estimate)
    return Report(study, estimate, seconds, tuple(problem.faults), kinds, problem.n_retried)
