"""Folders of trainings: what they hold, what they refuse, and drivers of a user's own recordings."""

from pathlib import Path

import pytest
import torch

from agents import load_driver, read_provenance
from agents.learned.coloured_noise import WHITE_NOISE
from agents.learned.networks import head_weights
from tests.training.data.recordings import simulate, write_highd, write_ngsim
from tests.training.imitation.synthetic_scenes import tiny
from training.imitation.algorithms.config import Config
from training.imitation.datasets import Source
from training.imitation.run_folder import read_training_settings, train_driver

OWN = Config(updates=2, epochs=1, pools=1, scenes=2, horizon=(3, 3), critic_batch=64, warm_up=1)


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


def test_a_folder_holds_a_driver_that_says_where_it_comes_from(made_up, tmp_path):
    config = tiny(method="mgail", updates=1, colour=WHITE_NOISE, horizon=(2, 3))
    path = train_driver(made_up, config, tmp_path / "run")
    driver = load_driver(path)
    assert driver.colour == WHITE_NOISE
    assert driver.name == "mgail"
    provenance = read_provenance(path)
    assert provenance.kind == "mgail"
    assert "--data tables --method mgail --seed 0 --updates 1" in provenance.command
    assert "--noise white" in provenance.command
    assert "--horizon 2 3" in provenance.command
    assert provenance.metrics["10 s"]["vehicles"] > 0
    assert "NGSIM" in provenance.data
    assert read_training_settings(tmp_path / "run") == (made_up, config)


def test_a_folder_keeps_to_its_settings(made_up, tmp_path):
    path = train_driver(made_up, tiny(updates=1), tmp_path, measured=False)
    first = head_weights(load_driver(path).policy)
    again = train_driver(made_up, tiny(updates=1), tmp_path, measured=False)
    assert torch.equal(head_weights(load_driver(again).policy), first)
    with pytest.raises(ValueError, match="other settings"):
        train_driver(made_up, tiny(updates=2), tmp_path, measured=False)
    with pytest.raises(ValueError, match=r"no training\.json"):
        read_training_settings(tmp_path / "elsewhere")


def test_a_training_that_could_not_begin_does_not_block_its_folder(tmp_path):
    """A typo in the path of the data, and the same folder again with the right one."""
    out = tmp_path / "run"
    with pytest.raises(ValueError, match=r"no ngsim_us101_scenes\.parquet in the folder 'nope'"):
        train_driver(Source("data", Path("nope")), tiny(updates=1), out)
    assert not out.exists()
    with pytest.raises(ValueError, match="Cannot read"):
        train_driver(Source("ngsim", tmp_path / "nope.csv"), tiny(updates=1), out)
    write_ngsim(tmp_path / "mine.csv", simulate(seed=1))
    source = Source("ngsim", tmp_path / "mine.csv")
    assert train_driver(source, tiny(updates=1), out, measured=False).exists()


@pytest.mark.parametrize("name", ["ngsim", "highd"])
def test_a_driver_learns_from_own_recordings(name, request, tmp_path):
    source = request.getfixturevalue(name)
    path = train_driver(source, OWN, tmp_path)
    provenance = read_provenance(path)
    assert f"--{name} " in provenance.command
    assert "--seconds 4" in provenance.command
    assert str(tmp_path.parent) not in provenance.command
    assert provenance.metrics["10 s"]["vehicles"] > 5
    assert ("non-commercial" in provenance.data_licence) == (name == "highd")
    actions, _ = load_driver(path).act(torch.zeros(1, 2, 51))
    assert torch.isfinite(actions).all()
