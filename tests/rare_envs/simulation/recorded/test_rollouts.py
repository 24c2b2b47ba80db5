"""Recorded rollouts are those of torch, and are made by torch where nothing can be recorded."""

import pickle

import pytest
import torch

from rare_envs.control.idm import IDM
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.simulation.recorded import RecordedRollouts
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
