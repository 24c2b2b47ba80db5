"""One evaluation: what is asked, checked in full before the first simulation, and what came out."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray

import agents
import rare_envs
import samplers
from rare_envs.egos.errors import EgoGone
from rare_envs.egos.faults import ON_FAULT, Fault, FaultTolerant
from rare_envs.plugins import did_you_mean
from rare_envs.problem import AmbiguousActions
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.rollout import drive
from rare_envs.study.crash_kinds import Kinds, look_again
from rare_envs.study.errors import BadInput
from rare_envs.study.journal import Journal, Journaled


@dataclass(frozen=True, kw_only=True)
class Question:
    """What an evaluation is asked: all of it, so that the same question gives the same answer.

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
        observation: What the ego observes: "features", "lidar", "kinematics", "camera" or "speed"; several joined by
            "+"; None for what it asks for itself, else "features".
        action: What a policy decides: "continuous" or "meta".
        collisions: Which collisions count: those of the "ego", or "any", those between two other vehicles too.
        weather: Whether weather and the camera's noise are parameters.
        on_error: What scenarios count as on which the ego fails twice: "raise" ends the run, "failure" counts them as
            failing, "bound" as failing in p and the upper end of the interval, but not in the lower end.
    """

    env_id: str
    ego: str = "idm"
    algo: str | None = None
    trust: bool = False
    method: str = "two-stage"
    base: str | None = None
    measure: str = "ttc"
    gamma: float = 0.0
    seed: int = 0
    max_sim: int | None = None
    target_cov: float | None = None
    replicates: int = 1
    noise: bool | str = True
    drivers: str | None = None
    horizon: float | None = None
    observation: str | None = None
    action: str = "continuous"
    on_error: str = "raise"
    collisions: str = "ego"
    weather: bool = False


@dataclass(frozen=True)
class Study:
    """A question with everything that it names, loaded and checked."""

    question: Question
    problem: rare_envs.DrivingProblem
    method: samplers.Stepping


@dataclass(frozen=True)
class Report:
    """The answer to a question.

    Attributes:
        study: What was asked.
        estimate: What the method found.
        seconds: Wall time of the estimation [s].
        faults: Scenarios on which the ego failed twice.
        n_retried: Simulations that were repeated to find them; not in n_sim.
        kinds: What the failures ended in.
    """

    study: Study
    estimate: samplers.Estimate
    seconds: float
    faults: tuple[Fault, ...] = ()
    kinds: Kinds = field(default_factory=Kinds)
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
        """What was asked for and makes no difference here, and what is not known."""
        unknown = (f"kinds of crash are not known: {self.kinds.unknown}",) if self.kinds.unknown else ()
        return (*self._idle_words, *self.study.problem.notes, *unknown)

    @property
    def _idle_words(self) -> tuple[str, ...]:
        world, noise = self.study.problem.world, self.study.question.noise
        if noise is True or world.sensing.weather or (world.background is not None and world.background.noisy):
            return ()
        word = "off" if noise is False else noise
        return (f"--noise {word} changes nothing: nobody in this traffic drives with noise (see --drivers)",)

    @property
    def vec_normalize(self) -> str | None:
        """File of the `VecNormalize` statistics that were applied to a saved ego's observations, if there was one."""
        path = getattr(self.study.problem.ego, "statistics_path", None)
        return None if path is None else str(path)

    def to_dict(self, top: int = 10) -> dict[str, Any]:
        """The report as JSON-ready values: question, estimate and the `top` most likely failures."""
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
        question: What is asked.

    Returns:
        The study, ready to run.

    Raises:
        BadInput: Something in the question cannot be used.
    """
    try:
        _check_on_error(question.on_error)
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
    except (ValueError, OSError) as error:
        raise BadInput(error) from error
    _try_ego(problem)
    return Study(replace(question, observation=problem.world.sensing.observation), problem, method)


def _check_on_error(word: str) -> None:
    if word not in ON_FAULT:
        raise ValueError(f"Unknown on_error {word!r}{did_you_mean(word, ON_FAULT)}; expected {', '.join(ON_FAULT)}.")


@torch.inference_mode()
def _try_ego(problem: rare_envs.DrivingProblem) -> None:
    """Let the ego decide twice, on ordinary traffic at time 0.

    So a broken one is found before the simulations, and one that answers differently from run to run.

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
        journal: Takes what is simulated, and gives what an earlier run had simulated.

    Returns:
        The report.

    Raises:
        BadInput: A number in the question is out of range (nothing is simulated then), or the ego failed on some x.
    """
    question, start = study.question, time.perf_counter()
    problem = FaultTolerant(study.problem, question.on_error)
    try:
        estimate = samplers.estimate(
            problem if journal is None else Journaled(problem, journal, study.problem.tile),
            study.method,
            gamma=question.gamma,
            seed=question.seed,
            max_sim=question.max_sim,
            target_cov=question.target_cov,
            replicates=question.replicates,
            on_error=cast("Literal['raise', 'failure', 'bound']", question.on_error),
            progress=progress,
        )
    except EgoGone as error:
        raise BadInput(f"{error}{'' if journal else ' With --out what was simulated would have been kept.'}") from error
    except ValueError as error:
        raise BadInput(error) from error
    seconds = time.perf_counter() - start
    kinds = look_again(study.problem, estimate)
    return Report(study, estimate, seconds, tuple(problem.faults), kinds, problem.n_retried)
