"""Study: a question with everything that it names, checked and loaded before the first simulation."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

import agents
import samplers
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import Distribution
from rare_envs.egos.errors import EgoGone
from rare_envs.egos.needs import AmbiguousActions, MissingStatistics
from rare_envs.measures.registry import MEASURES
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.rollout import drive
from rare_envs.study.arguments import Question
from rare_envs.study.errors import BadInput, as_bad_input


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
        """Return the same study with another base distribution, by name or file; the ego is the one that is loaded."""
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
    """Return the problem of a question; what it cannot check is among its notes, without a warning."""
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
