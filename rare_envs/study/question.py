"""Question: all inputs of an evaluation, checked and loaded before the first simulation."""

from __future__ import annotations

import itertools
import reprlib
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch

import agents
import samplers
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import Distribution
from rare_envs.egos.errors import EgoGone
from rare_envs.egos.spaces.ambiguities import AmbiguousActions, MissingStatistics
from rare_envs.measures.registry import MEASURES
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import find_scenario, split_layout
from rare_envs.simulation.rollout import drive
from rare_envs.study.errors import BadInput, as_bad_input
from samplers.errors import OnError
from samplers.execution.arguments import RunArguments
from samplers.validation import check_whole


@dataclass(frozen=True, kw_only=True)
class Question:
    """All inputs of an evaluation: the same question gives the same answer.

    Attributes:
        env_id: Environment, such as "rare_envs/CutIn-v0".
        ego: "idm", a learned driver ("mgail", "gail" or its file), a path to a Stable-Baselines3 `.zip`, or
            `module:function`.
        algo: Algorithm of a `.zip`; recognised from the file when None.
        stats: File of the `VecNormalize` statistics of a `.zip`; None to look for one beside it.
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
            "+"; None for the one that its space fits, "features" where it declares none.
        action: Actions of a policy: "continuous", "discrete" or "meta"; None for those that its space fits.
        collisions: Which collisions count: those of the "ego", or "any", those between two other vehicles too.
        weather: Whether weather and the camera's noise are parameters.
        ensemble: Whether the base distribution is the mixture of the refits of `base`: what these predict for the next
            event.
        ensemble_run: Whether a further run under that mixture may be made, of up to as many simulations again, where
            the failures of the first do not tell p under the refits.
        also_under: Further base distributions, names or files joined by commas, under which p is stated too.
        on_error: Treatment of scenarios on which the ego fails twice: "raise" ends the run, "failure" counts them as
            failing, "bound" as failing in p and the upper end of the interval, but not in the lower end.
        chunk: Simulations at once; None for as many as suit one process. A network rounds differently by batch, so this
            number, unlike that of workers, belongs to the question; with workers it is `DrivingProblem.chunk_size`.
        core: What simulates, as in `DrivingProblem`: "torch", "numba" or "auto". A
            run goes on with what it began with.
        device: Where torch simulates, as in `DrivingProblem`: "cpu", or a GPU, such as "cuda".
        sensitivity: Whether the report says what p is sensitive to; that takes no simulations.
        max_p: Limit that p is compared with, or None. The intervals of the answer have then ends at the one-sided
            `gate_confidence`, a coverage of twice that less 1.
        gate_confidence: One-sided confidence of the comparison with `max_p`.
        given_base: Whether the comparison takes the base distribution as given, without the uncertainty of its fit.

    Example:
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", ego="idm", gamma=3.0, seed=1)
        >>> question.run_arguments.gamma, question.method
        (3.0, 'auto')
    """

    env_id: str
    ego: str = "idm"
    algo: str | None = None
    stats: str | None = None
    trust: bool = False
    method: str = "auto"
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
    action: str | None = None
    on_error: str = RunArguments.on_error
    collisions: str = "ego"
    weather: bool = False
    ensemble: bool = False
    ensemble_run: bool = True
    also_under: str | None = None
    sensitivity: bool = False
    max_p: float | None = None
    gate_confidence: float = 0.95
    given_base: bool = False
    chunk: int | None = None
    core: str = "auto"
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Take an id with HighwayEnv's layout as that of the scenario, with the observation and actions it means."""
        env_id, layout = split_layout(self.env_id)
        object.__setattr__(self, "env_id", env_id)
        if layout:
            object.__setattr__(self, "observation", self.observation or layout["observation"])
            object.__setattr__(self, "action", self.action or layout["action"])

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

    def check(self) -> samplers.Stepping:
        """Return the method, after a check of all that is known before the ego is loaded, which takes seconds.

        Raises:
            ValueError: An argument of `samplers.estimate` is out of range, or there is no such method or environment.
        """
        _ = self.run_arguments
        if self.chunk is not None:
            check_whole("chunk", self.chunk, 1)
        method = samplers.get_method(self.method)
        find_scenario(self.env_id)
        return method


_JSON_TYPES: dict[str, tuple[type, ...]] = {
    "str": (str,),
    "int": (int,),
    "float": (int, float),
    "bool": (bool,),
    "None": (type(None),),
}
"""Names in the annotations of `Question` to types in JSON."""
TYPE_WORDS = {"str": "a text", "int": "a whole number", "float": "a number", "bool": "true or false", "None": "null"}
"""What the messages call them."""


def read_question(values: Any) -> Question:
    """Return the question that a file has, without the fields that this version does not know.

    Args:
        values: From JSON, of any form.

    Raises:
        BadInput: It is no question.
    """
    if not isinstance(values, dict) or "env_id" not in values:
        raise BadInput(f"Expected a recorded question, an object with env_id, got {reprlib.repr(values)}.")
    known = {each.name: str(each.type) for each in fields(Question) if each.name in values}
    for name, annotation in known.items():
        types = tuple(kind for word in annotation.split(" | ") for kind in _JSON_TYPES[word])
        value = values[name]
        if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
            wanted = " or ".join(TYPE_WORDS[word] for word in annotation.split(" | "))
            raise BadInput(f"Expected {name} of the recorded question to be {wanted}, got {reprlib.repr(value)}.")
    return Question(**{name: values[name] for name in known})


@dataclass(frozen=True)
class Study:
    """A question with everything that it names, loaded and checked.

    Example:
        >>> study = prepare(Question(env_id="rare_envs/CarFollowing-v0", method="mc"))
        >>> study.problem.space.names, study.method.name
        (('ego_speed', 'lead_speed', 'gap'), 'mc')
    """

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
        """Return the same study with another base distribution, by name or file; the ego is the one that is loaded.

        Raises:
            ValueError: There is no such base, or it does not fit the scenario.
            OSError: A file cannot be read.
        """
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
        rare_envs.study.errors.BadInput: Expected seed to be a whole number of at least 0, got -1.
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
    """Return the problem of a question; what it cannot check is among its notes, without a warning.

    Args:
        question: The question.
        ego: The ego that it names, loaded.

    Raises:
        ValueError: An argument is invalid or the ego does not fit.
        OSError: A file cannot be read.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AmbiguousActions)
        warnings.simplefilter("ignore", MissingStatistics)  # the report says it
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
