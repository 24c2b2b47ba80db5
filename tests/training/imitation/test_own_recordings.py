"""A user's own files, raw NGSIM and highD: read, cut into scenes, learned from, driven."""

import pytest
import torch

from agents import load_driver, read_provenance
from tests.training.data.recordings import simulate, write_highd, write_ngsim
from training.imitation.algorithms.config import Config
from training.imitation.datasets import Source, load_scenes
from training.imitation.run_folder import train_driver

TINY = Config(updates=2, epochs=1, pools=1, scenes=2, horizon=(3, 3), critic_batch=64, warm_up=1)


@pytest.fixture(scope="module")
def ngsim(tmp_path_factory):
    path = tmp_path_factory.mktemp("ngsim") / "us-101.csv"
    write_ngsim(path, simulate(seed=1, per_lane=8, seconds=16.0))
    return Source("ngsim", path, seconds=4.0)


@pytest.fixture(scope="module")
def highd(tmp_path_factory):
    folder = tmp_path_factory.mktemp("highd")
    write_highd(folder, simulate(seed=2, per_lane=6, seconds=16.0), simulate(seed=3, lanes=2, per_lane=6, seconds=16.0))
    return Source("highd", folder, recordings=("01",), seconds=4.0)


@pytest.mark.parametrize("name", ["ngsim", "highd"])
def test_a_driver_learns_from_own_recordings(name, request, tmp_path):
    source = request.getfixturevalue(name)
    path = train_driver(source, TINY, tmp_path)
    provenance = read_provenance(path)
    assert f"--{name} " in provenance.command
    assert "--seconds 4" in provenance.command
    assert str(tmp_path.parent) not in provenance.command
    assert provenance.metrics["10 s"]["vehicles"] > 5
    assert ("non-commercial" in provenance.data_licence) == (name == "highd")
    actions, _ = load_driver(path).act(torch.zeros(1, 2, 51))
    assert torch.isfinite(actions).all()


def test_both_directions_are_learned_from_and_their_ends_kept_for_tests(highd):
    learn, test = load_scenes(highd)
    sides = {scene.name.rsplit("-", 1)[0] for scene in learn}
    assert sides == {"01-upper", "01-lower"} == {scene.name.rsplit("-", 1)[0] for scene in test}
    for side in sides:
        ends = [[s for s in scenes if s.name.startswith(side)] for scenes in (learn, test)]
        assert max(scene.end for scene in ends[0]) < min(scene.start for scene in ends[1])
    assert {scene.name for scene in load_scenes(Source("highd", highd.path, seconds=4.0))[0]} == {s.name for s in learn}
