"""Recorded rollouts are those of torch, and are made by torch where nothing can be recorded."""

import pickle
from dataclasses import replace
from typing import Any

import pytest
import torch

from rare_envs.control.idm import IDM
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.recorded import RecordedRollouts, rollouts
from rare_envs.simulation.rollout import rollout
from rare_envs.simulation.world import World

X = torch.tensor([[20.0, 12.0, 12.0, 20.0, 40.0, 3.5], [30.0, 25.0, 9.0, 20.0, 40.0, -3.5]])


@pytest.mark.parametrize(("tile", "sizes"), [(4096, (64, 256, 1024, 4096)), (16, (1, 4, 16)), (1, (1,))])
def test_a_tile_its_quarter_and_so_on_are_recorded(tile: int, sizes: tuple[int, ...]) -> None:
    assert RecordedRollouts(IDM(), tile).sizes == sizes


def test_on_the_cpu_nothing_is_recorded() -> None:
    recorded = RecordedRollouts(IDM(), 64)
    assert torch.equal(recorded(World(CUT_IN), X).f, rollout(World(CUT_IN), IDM(), X).f)


def test_another_process_takes_over_all_but_the_recordings() -> None:
    recorded = pickle.loads(pickle.dumps(RecordedRollouts(IDM(), 64)))
    assert recorded.sizes == (1, 4, 16, 64)
    assert recorded(World(CUT_IN), X).f.shape == (2,)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[World, int]]:
    """Worlds and sizes of the recordings that are made, of which only the places of x are there."""
    asked: list[tuple[World, int]] = []

    def record(world: World, driver: Any, x: torch.Tensor, size: int) -> Any:
        asked.append((world, size))
        return rollouts._Recording(world, x[0].expand(size, -1).clone(), None, None)  # type: ignore[arg-type]

    monkeypatch.setattr(rollouts, "record", record)
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
    worlds = [World(CUT_IN, clock=Clock(dt=0.1, horizon=1.0 + 0.1 * n)) for n in range(rollouts.MOST_RECORDINGS + 1)]
    for world in (*worlds[:-1], worlds[0], worlds[-1], worlds[0]):
        recorded._find(world, X)
    assert [world for world, _ in made] == worlds
    recorded._find(worlds[1], X)
    assert made[-1][0] == worlds[1]
    assert len(recorded._recordings) == rollouts.MOST_RECORDINGS


def test_a_record_that_broke_off_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []
    monkeypatch.setattr(rollouts, "record", lambda *given: tried.append(given))
    recorded = RecordedRollouts(IDM(), 64)
    assert recorded._find(World(CUT_IN), X) is None
    assert recorded._find(World(CUT_IN), X[:1]) is None
    assert len(tried) == 1


def test_where_memory_is_short_the_recordings_go_first(
    made: list[tuple[World, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded, record = RecordedRollouts(IDM(), 64), rollouts.record
    recorded._find(World(CUT_IN), X[:1])

    def record_if_there_is_room(*given: Any) -> Any:
        if recorded._recordings:
            raise torch.OutOfMemoryError
        return record(*given)

    monkeypatch.setattr(rollouts, "record", record_if_there_is_room)
    assert recorded._find(World(CUT_IN), X) is not None
    assert [len(each.x) for each in recorded._recordings] == [4]
