"""Recorded rollouts are those of torch; what changes between two rollouts, as of users, is not recorded."""

from dataclasses import replace
from typing import Any

import torch

import agents
from agents.learned.rules import CollisionAvoidance
from rare_envs.control.idm import IDM
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.egos.policy import as_driver
from rare_envs.measures import MEASURES, Measure, Moment
from rare_envs.measures.registry import PAIR_CLEARANCE, TermTracker
from rare_envs.scenarios.cut_in import CUT_IN, CUT_IN_V1, CutterModel
from rare_envs.scenarios.highway import HIGHWAY
from rare_envs.simulation import cuda_graphs
from rare_envs.simulation.cuda_graphs import RecordedRollouts, is_recordable
from rare_envs.simulation.settings import Clock, Measurement
from rare_envs.simulation.world import World, rollout

X = torch.tensor([[20.0, 12.0, 12.0, 20.0, 40.0, 3.5], [30.0, 25.0, 9.0, 20.0, 40.0, -3.5]])


def test_on_the_cpu_nothing_is_recorded() -> None:
    recorded = RecordedRollouts(IDM(), 64)
    assert torch.equal(recorded(World(CUT_IN), X).f, rollout(World(CUT_IN), IDM(), X).f)


def test_each_world_and_size_is_recorded_once_and_what_was_not_played_for_longest_goes_first(monkeypatch) -> None:
    """Nothing is recorded here; the places of x are there. Where memory is short, all recordings go first."""
    made: list[tuple[World, int]] = []

    def record(world: World, driver: Any, x: torch.Tensor, size: int) -> Any:
        if size == 16 and recorded._recordings:
            raise torch.OutOfMemoryError
        made.append((world, size))
        return cuda_graphs.Recording(world, x[0].expand(size, -1).clone(), None if world == broken else object())

    monkeypatch.setattr(cuda_graphs, "record", record)
    recorded, broken = RecordedRollouts(IDM(), 64), World(CUT_IN, measurement=Measurement("thw"))
    for world in (World(CUT_IN), replace(World(CUT_IN)), broken):
        for rows in (X, X[:1], torch.cat((X, X))):
            found = recorded._find(world, rows)
            assert found is not None and found.world == world
            assert found.graph is None or len(found.x) == (1 if len(rows) == 1 else 4)
    assert [size for _, size in made] == [4, 1, 4]  # what broke off is not tried again
    recorded._find(World(CUT_IN), torch.cat([X] * 8))
    assert [len(each.x) for each in recorded._recordings] == [16]
    worlds = [World(CUT_IN, clock=Clock(dt=0.1, horizon=1.0 + 0.1 * n)) for n in range(cuda_graphs.MOST_RECORDINGS + 1)]
    made.clear()
    for world in (*worlds[:-1], worlds[0], worlds[-1], worlds[0], worlds[1]):
        recorded._find(world, X)
    assert [world for world, _ in made] == [*worlds, worlds[1]]


def own_gap(moment: Moment) -> torch.Tensor:
    return moment.lead.gap


def test_egos_and_drivers_of_this_package_are_recorded() -> None:
    for ego in ("idm", "human", "noisy:idm"):
        for world in (World(CUT_IN), World(CUT_IN_V1)):
            assert is_recordable(world, as_driver(agents.load_ego(ego), world))
    for drivers in (agents.load_driver("mgail"), LaneChangingDriver(), agents.load_driver("idm")):
        assert is_recordable(World(HIGHWAY, background=drivers), IDM())


def test_what_a_user_made_of_a_driver_or_a_scenario_is_not_recorded() -> None:
    class Hesitant(IDM):
        """Its class says nothing, and what it inherits does not count."""

    class Bold(CollisionAvoidance):
        """Rules of one's own."""

    assert not is_recordable(World(CUT_IN), Hesitant())
    assert not is_recordable(World(replace(CUT_IN, initial=lambda x: CUT_IN.initial(x))), IDM())
    assert not is_recordable(World(type("Bolder", (CutterModel,), {"__module__": "mine"})().scenario()), IDM())
    assert not is_recordable(World(replace(CUT_IN_V1, signals=lambda state: state.x[:, 1:] > 0.0)), IDM())
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
