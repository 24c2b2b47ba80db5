"""Recorded rollouts are those of torch; what changes between two rollouts, as of users, is not recorded."""

from dataclasses import replace
from typing import Any

import pytest
import torch

import agents
from agents.learned.rules import CollisionAvoidance
from rare_envs.control.idm import IDM
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.egos.policy import as_driver
from rare_envs.measures import MEASURES, Measure, Moment
from rare_envs.measures.registry import PAIR_CLEARANCE, TermTracker
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.scenarios.highway import HIGHWAY
from rare_envs.simulation import cuda_graphs
from rare_envs.simulation.cuda_graphs import RecordedRollouts, is_recordable
from rare_envs.simulation.world import Clock, Measurement, World, rollout

X = torch.tensor([[20.0, 12.0, 12.0, 20.0, 40.0, 3.5], [30.0, 25.0, 9.0, 20.0, 40.0, -3.5]])


def test_on_the_cpu_nothing_is_recorded() -> None:
    recorded = RecordedRollouts(IDM(), 64)
    assert torch.equal(recorded(World(CUT_IN), X).f, rollout(World(CUT_IN), IDM(), X).f)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[World, int]]:
    """Worlds and sizes of the recordings that are made, of which only the places of x are there."""
    asked: list[tuple[World, int]] = []

    def record(world: World, driver: Any, x: torch.Tensor, size: int) -> Any:
        asked.append((world, size))
        return cuda_graphs._Recording(world, x[0].expand(size, -1).clone(), None, None)  # type: ignore[arg-type]

    monkeypatch.setattr(cuda_graphs, "record", record)
    return asked


def test_each_world_and_size_is_recorded_once(made: list[tuple[World, int]]) -> None:
    recorded, other = RecordedRollouts(IDM(), 64), World(CUT_IN, measurement=Measurement("pet"))
    for world in (World(CUT_IN), other, World(CUT_IN), replace(other)):
        for rows in (X, X[:1], torch.cat((X, X))):
            found = recorded._find(world, rows)
            assert found is not None
            assert (found.world, len(found.x)) == (world, 1 if len(rows) == 1 else 4)
    assert len(made) == 4


def test_what_was_not_played_for_longest_goes_first(made: list[tuple[World, int]]) -> None:
    recorded = RecordedRollouts(IDM(), 4)
    worlds = [World(CUT_IN, clock=Clock(dt=0.1, horizon=1.0 + 0.1 * n)) for n in range(cuda_graphs.MOST_RECORDINGS + 1)]
    for world in (*worlds[:-1], worlds[0], worlds[-1], worlds[0]):
        recorded._find(world, X)
    assert [world for world, _ in made] == worlds
    recorded._find(worlds[1], X)
    assert made[-1][0] == worlds[1]
    assert len(recorded._recordings) == cuda_graphs.MOST_RECORDINGS


def test_a_record_that_broke_off_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []
    monkeypatch.setattr(cuda_graphs, "record", lambda *given: tried.append(given))
    recorded = RecordedRollouts(IDM(), 64)
    assert recorded._find(World(CUT_IN), X) is None
    assert recorded._find(World(CUT_IN), X[:1]) is None
    assert len(tried) == 1


def test_where_memory_is_short_the_recordings_go_first(
    made: list[tuple[World, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded, record = RecordedRollouts(IDM(), 64), cuda_graphs.record
    recorded._find(World(CUT_IN), X[:1])

    def record_if_there_is_room(*given: Any) -> Any:
        if recorded._recordings:
            raise torch.OutOfMemoryError
        return record(*given)

    monkeypatch.setattr(cuda_graphs, "record", record_if_there_is_room)
    assert recorded._find(World(CUT_IN), X) is not None
    assert [len(each.x) for each in recorded._recordings] == [4]


def own_gap(moment: Moment) -> torch.Tensor:
    return moment.lead.gap


def test_egos_and_drivers_of_this_package_are_recorded() -> None:
    for ego in ("idm", "human", "noisy:idm"):
        assert is_recordable(World(CUT_IN), as_driver(agents.load_ego(ego), World(CUT_IN)))
    for drivers in (agents.load_driver("mgail"), LaneChangingDriver(), agents.load_driver("idm")):
        assert is_recordable(World(HIGHWAY, background=drivers), IDM())


def test_what_a_user_made_of_a_driver_or_a_scenario_is_not_recorded() -> None:
    class Hesitant(IDM):
        """Its class says nothing, and what it inherits does not count."""

    class Bold(CollisionAvoidance):
        """Rules of one's own."""

    assert not is_recordable(World(CUT_IN), Hesitant())
    assert not is_recordable(World(replace(CUT_IN, initial=lambda x: CUT_IN.initial(x))), IDM())
    behind = replace(as_driver(agents.load_ego("noisy:idm"), World(CUT_IN)), inner=Hesitant())
    assert not is_recordable(World(CUT_IN), behind)
    driver: Any = agents.load_driver("mgail")
    changed = replace(driver, avoidance=Bold())
    assert not is_recordable(World(HIGHWAY, background=changed), IDM())
    assert is_recordable(World(CUT_IN), agents.LearnedEgo(driver))
    assert not is_recordable(World(CUT_IN), agents.LearnedEgo(changed))


def test_measures_of_this_package_are_recorded_with_their_terms_and_users_are_not() -> None:
    for measure in MEASURES:
        assert is_recordable(World(CUT_IN, measurement=Measurement(measure)), IDM())
    tracked = TermTracker(MEASURES["ttc"], PAIR_CLEARANCE)
    assert is_recordable(World(CUT_IN, measurement=Measurement(tracked)), IDM())
    for own in (own_gap, Measure(own_gap)):
        assert not is_recordable(World(CUT_IN, measurement=Measurement(own)), IDM())
