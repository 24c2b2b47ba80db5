"""Trainings from files to drivers: folders, the user's own recordings, command lines, logs, what is refused."""

import dataclasses
import inspect
import json
import sys
from pathlib import Path

import pytest
import torch
import typer
from typer.testing import CliRunner

from agents import load_driver, read_provenance
from agents.learned.networks import WHITE_NOISE, head_weights
from tests.training.data.recordings import simulate, write_highd
from tests.training.imitation.synthetic_scenes import TINY, scene, scenes, tiny
from training.imitation import __main__ as command_line
from training.imitation.config import Config
from training.imitation.train import (
    Source,
    command_of,
    make_learner,
    prepare_data,
    read_training_settings,
    split_end,
    train_driver,
    train_learner,
)

OWN = Config(updates=1, epochs=1, pools=1, scenes=2, horizon=(3, 3), critic_batch=64, warm_up=1)


@pytest.fixture(scope="module")
def traffic():
    return simulate(seed=2, lanes=2, per_lane=6, seconds=16.0)


def run(words):
    command = typer.Typer()
    command.command()(command_line.main)
    return CliRunner().invoke(command, words)


def test_a_folder_holds_a_driver_that_says_where_it_comes_from(made_up, tmp_path):
    config = tiny(method="mgail", updates=1, noise="white", horizon=(2, 3))
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


def test_a_training_that_could_not_begin_does_not_block_its_folder(tmp_path):
    out = tmp_path / "run"
    with pytest.raises(ValueError, match=r"no ngsim_us101_scenes\.parquet in the folder 'nope'"):
        train_driver(Source("data", Path("nope")), tiny(updates=1), out)
    assert not out.exists()
    with pytest.raises(ValueError, match="Nobody follows"):
        prepare_data([scene(vehicles=3)])
    with pytest.raises(ValueError, match=r"no training\.json"):
        read_training_settings(tmp_path / "elsewhere")


def test_a_driver_learns_from_own_recordings(traffic, tmp_path):
    path = tmp_path / "highd"
    write_highd(path, traffic, simulate(seed=3, lanes=2, per_lane=4, seconds=8.0))
    driver = train_driver(Source("highd", path, seconds=4.0), OWN, tmp_path / "run")
    provenance = read_provenance(driver)
    assert "--highd highd --seconds 4" in provenance.command and str(tmp_path) not in provenance.command
    assert provenance.metrics["10 s"]["vehicles"] > 5
    assert "non-commercial" in provenance.data_licence
    actions, _ = load_driver(driver).act(torch.zeros(1, 2, 51))
    assert torch.isfinite(actions).all()


def test_the_end_of_each_recording_is_kept_for_tests():
    named = [dataclasses.replace(scenes(1)[0], name=f"{side}-{start}") for side in "ab" for start in range(10)]
    learn, test = split_end(named)
    assert [scene.name for scene in test] == ["a-8", "a-9", "b-8", "b-9"]
    assert len(learn) == 16
    assert split_end(named[:1])[1] == ()


def test_a_command_repeats_its_training_and_says_what_is_missing(monkeypatch, tmp_path):
    """What is written into a file, read by the command line, gives the same settings."""
    for words, message in (
        ([], "one of --data"),
        (["--data", "nowhere"], "nowhere"),
        (["--ngsim", "a", "--highd", "b"], "one of"),
        (["--data", "nowhere", "--pools", "0"], "Expected pools >= 1, got 0"),
    ):
        result = run([*words, "--out", str(tmp_path / "run")])
        assert result.exit_code == 2 and message in result.output
    options = {name: option.default for name, option in inspect.signature(command_line.main).parameters.items()}
    assert {field.name: field.default for field in dataclasses.fields(Config)}.items() <= options.items()
    config = tiny(method="gail", seed=4, noise="white", clone_weight=(0.2, 0.1))
    found = []
    monkeypatch.setattr(command_line, "train_driver", lambda *given, **how: found.append((*given, how)) or tmp_path)
    for device in ("cpu", "cuda:1"):
        result = run(
            [*command_of(Source("data", Path("somewhere/tables")), config, device).split()[3:], "--out", str(tmp_path)]
        )
        assert result.exit_code == 0, result.output
        source, settings, _, how = found.pop()
        assert (source, settings, how["device"]) == (Source("data", Path("tables")), config, device)


def test_every_setting_has_help_and_json_is_one_object(monkeypatch, tmp_path):
    monkeypatch.setattr(command_line, "train_driver", lambda *given, **how: print("progress") or tmp_path / "it")
    result = run(["--data", "tables", "--method", "gail", "--updates", "7", "--json", "--out", str(tmp_path)])
    assert json.loads(result.stdout) == {"driver": str(tmp_path / "it"), "method": "gail", "seed": 0}
    parameters = inspect.signature(command_line.main).parameters
    assert not [name for name in parameters if not parameters[name].annotation.__metadata__[0].help]


def test_logs_go_to_tensorboard(data, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "torch.utils.tensorboard", None)
        with pytest.raises(ValueError, match=r"pip install .*\[logs\]"):
            train_learner(make_learner(data, TINY), tmp_path, log=True)
    pytest.importorskip("tensorboard", reason="the extra logs is optional")
    train_learner(make_learner(data, tiny(updates=2)), tmp_path, log=True)
    assert list(tmp_path.glob("events.out.*"))
