"""Settings that must fit together."""

from copy import deepcopy
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from typing import get_args

import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space, parabola, shell
from samplers.method import Goal
from samplers.methods.two_stage.exploration import Sizes
from samplers.methods.two_stage.method import run_two_stage
from samplers.methods.two_stage.mixture.proposal import Kind
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, TermsAloneSettings
from samplers.methods.two_stage.terms.settings import TermSettings

REFINEMENT = DEFAULT_SETTINGS.refinement


NOISE = np.random.default_rng(0)
RUNS = {
    "one region": (parabola().problem, 6000, None),
    "two regions": (samplers.FunctionProblem(lambda u: 3.0 - np.abs(u[:, 0]), 5), 2000, None),
    "many dimensions": (half_space(60).problem, 2000, None),
    "many faces": (samplers.FunctionProblem(lambda u: 4.2 - np.abs(u).max(axis=1), 10), 6000, None),
    "sixteen faces": (samplers.FunctionProblem(lambda u: 4.2 - np.abs(u).max(axis=1), 8), 6000, None),
    "all around": (shell().problem, 6000, None),
    "a sum of losses": (samplers.FunctionProblem(lambda u: 19.0 - np.exp(0.8 * u).sum(axis=1), 5), 6000, None),
    "noise": (samplers.FunctionProblem(lambda u: 3.0 - u[:, 0] + NOISE.normal(size=len(u)), 2), 2000, None),
    "subset simulation instead": (samplers.FunctionProblem(lambda u: 4.5 - np.abs(u).max(axis=1), 20), 6000, 0.9),
    "Monte Carlo instead": (half_space(2, 0.5).problem, 1000, None),
    "until a target is met": (half_space(2).problem, 2000, 0.1),
}
"""Problem, simulations to plan for and target c.o.v. of runs that, together, come to all parts of the method."""


def groups(settings):
    """Yield a group of settings and all groups in it, save those of searches by terms, which have their own tests."""
    yield settings
    for field in fields(settings):
        if is_dataclass(value := getattr(settings, field.name)) and not isinstance(
            value, TermSettings | TermsAloneSettings
        ):
            yield from groups(value)


@pytest.fixture
def reads(monkeypatch):
    """Reads of numbers, as (id of the group, name of the field)."""
    found = set()

    def record(group, name):
        found.add((id(group), name))
        return object.__getattribute__(group, name)

    for group in groups(DEFAULT_SETTINGS):
        monkeypatch.setattr(type(group), "__getattribute__", record)
    return found


def test_runs_read_every_number_from_the_settings_given_and_none_elsewhere(drive, reads):
    """Equal copies are given; whoever reads a default one was not handed its group."""
    own = deepcopy(DEFAULT_SETTINGS)
    numbers = {
        (id(group), field.name): f"{type(group).__name__}.{field.name}"
        for some in (own, DEFAULT_SETTINGS)
        for group in groups(some)
        for field in fields(group)
        if field.name not in ("terms", "terms_alone")
    }
    ids = {id(group) for group in groups(own)}
    reads.clear()
    for problem, n, target in RUNS.values():
        goal = Goal(gamma=0.0, max_sim=n if target is None else None, target_cov=target)
        drive(run_two_stage(problem, goal, n, np.random.default_rng(0), own), problem)
    found = reads & numbers.keys()
    assert {numbers[key] for key in found if key[0] not in ids} == set()
    assert {name for key, name in numbers.items() if key[0] in ids and key not in found} == set()


def test_every_kind_of_component_has_an_initial_share():
    assert set(REFINEMENT.initial_shares) == set(get_args(Kind))


def test_lower_limits_leave_room_for_what_is_best():
    """Base draws, tempered Gaussians (no other draw failing) and regions; base and tempered where f is noisy."""
    base, tempered = REFINEMENT.base_share, REFINEMENT.tempered_share + REFINEMENT.extra_tempered_share
    assert base + tempered + max(REFINEMENT.region_share, REFINEMENT.final_region_share, REFINEMENT.radial_share) < 1
    assert REFINEMENT.noisy_base_share + REFINEMENT.noisy_tempered_share < 1


@pytest.mark.parametrize("budget", [400, 6000, 100_000])
def test_half_of_what_the_exploration_may_leave_is_for_the_estimate(budget):
    left = budget - Sizes.within(budget).limit
    assert 0.5 * left < left * (1 - sum(REFINEMENT.round_shares))
    assert left / 3 < left * (1 - sum(REFINEMENT.round_shares) - sum(REFINEMENT.further_shares))


def test_settings_cannot_be_changed_but_replaced():
    with pytest.raises(FrozenInstanceError):
        DEFAULT_SETTINGS.min_exploration_budget = 1  # type: ignore[misc]
    assert replace(DEFAULT_SETTINGS, min_exploration_budget=1).min_exploration_budget == 1


def test_a_run_takes_its_numbers_from_the_settings_given(drive):
    """Other rounds are another number of levels; the smallest budget decides on plain Monte Carlo."""
    problem = samplers.FunctionProblem(lambda u: 3.0 - u[:, 0], 2)

    def levels(settings):
        steps = run_two_stage(problem, Goal(gamma=0.0, max_sim=1000), 1000, np.random.default_rng(0), settings)
        return len(drive(steps, problem).value.trace)

    assert levels(DEFAULT_SETTINGS) == 6  # first draws, regions, three rounds, estimate
    two_rounds = replace(DEFAULT_SETTINGS, refinement=replace(REFINEMENT, round_shares=(0.1, 0.2)))
    assert levels(two_rounds) == 5
    assert levels(replace(DEFAULT_SETTINGS, min_exploration_budget=2000)) == 1
