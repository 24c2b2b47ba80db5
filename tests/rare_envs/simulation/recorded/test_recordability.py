"""What changes between two rollouts is not recorded: users' drivers, measures and scenarios."""

from dataclasses import replace
from typing import Any

import pytest
import torch

import agents
from agents.learned.lane_changes import LaneChanges
from rare_envs.control.idm import IDM
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.egos.policy import as_driver
from rare_envs.measures import MEASURES, Measure, Moment
from rare_envs.measures.registry import PAIR_CLEARANCE
from rare_envs.measures.terms import TermTracker
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.scenarios.highway import HIGHWAY
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.recorded.recordability import is_recordable
from rare_envs.simulation.world import World

WORLD = World(CUT_IN)


def own_gap(moment: Moment) -> torch.Tensor:
    return moment.lead.gap


class Steady:
    """A user's driver."""

    def act(self, episode: Any, memory: Any) -> tuple[torch.Tensor, Any]:
        return torch.zeros(len(episode.collided), 2), memory


@pytest.mark.parametrize("ego", ["idm", "human", "noisy:idm"])
def test_egos_of_this_package_are_recorded(ego: str) -> None:
    assert is_recordable(WORLD, as_driver(agents.load_ego(ego), WORLD))


@pytest.mark.parametrize("drivers", [agents.load_driver("mgail5"), LaneChangingDriver(), agents.load_driver("idm")])
def test_drivers_of_this_package_are_recorded(drivers: Any) -> None:
    assert is_recordable(World(HIGHWAY, background=drivers), IDM())


def test_egos_of_users_are_not_recorded_nor_behind_a_stack() -> None:
    assert not is_recordable(WORLD, Steady())
    behind = replace(as_driver(agents.load_ego("noisy:idm"), WORLD), inner=Steady())
    assert not is_recordable(WORLD, behind)


def test_what_a_user_made_of_a_driver_of_this_package_is_not_recorded() -> None:
    class Hesitant(IDM):
        """Its class says nothing, and what it inherits does not count."""

    class Bold(LaneChanges):
        """Rules of one's own."""

    assert not is_recordable(WORLD, Hesitant())
    behind = replace(as_driver(agents.load_ego("noisy:idm"), WORLD), inner=Hesitant())
    assert not is_recordable(WORLD, behind)
    driver: Any = agents.load_driver("mgail5")
    changed = replace(driver, changes=Bold())
    assert not is_recordable(World(HIGHWAY, background=changed), IDM())
    assert is_recordable(WORLD, agents.LearnedEgo(driver))
    assert not is_recordable(WORLD, agents.LearnedEgo(changed))


@pytest.mark.parametrize("measure", MEASURES)
def test_measures_of_this_package_are_recorded_with_their_terms(measure: str) -> None:
    assert is_recordable(replace(WORLD, measurement=Measurement(measure)), IDM())
    tracked = TermTracker(MEASURES[measure], PAIR_CLEARANCE)
    assert is_recordable(replace(WORLD, measurement=Measurement(tracked)), IDM())


def test_measures_of_users_are_not_recorded() -> None:
    for measure in (own_gap, Measure(own_gap)):
        assert not is_recordable(replace(WORLD, measurement=Measurement(measure)), IDM())


def test_scenarios_of_users_are_not_recorded() -> None:
    mine = replace(CUT_IN, initial=lambda x: CUT_IN.initial(x))
    assert not is_recordable(World(mine), IDM())
