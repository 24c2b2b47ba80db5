"""Settings that must fit together."""

from dataclasses import FrozenInstanceError, replace
from typing import get_args

import numpy as np
import pytest

import samplers
from samplers.method import Goal
from samplers.methods.two_stage.exploration import Sizes
from samplers.methods.two_stage.method import run_two_stage
from samplers.methods.two_stage.mixture.proposal import Kind
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS

REFINEMENT = DEFAULT_SETTINGS.refinement


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
