"""The command lines that train drivers: every setting, repeatable commands, one line for an error."""

import dataclasses
import inspect
import json
from pathlib import Path

import pytest

from agents import read_provenance
from agents.learned.coloured_noise import WHITE_NOISE
from tests.training.imitation.synthetic_scenes import tiny
from training.imitation import train as command_line
from training.imitation.algorithms.config import Config
from training.imitation.datasets import Source
from training.imitation.run_folder import command_of


def rare_envs_command(words):
    from rare_envs.study.cli.app import app

    with pytest.raises(SystemExit) as stop:
        app(words, prog_name="rare-envs")
    return stop.value.code


def test_the_command_line_has_every_setting():
    options = inspect.signature(command_line.main).parameters
    names = {option.name for option in dataclasses.fields(Config)} - {"colour"} | {"noise"}
    assert names <= set(options)
    for option in dataclasses.fields(Config):
        if option.name in options:
            default = options[option.name].default
            assert getattr(default, "value", default) == option.default, option.name


@pytest.mark.parametrize("device", ["cpu", "cuda:1"])
def test_a_command_repeats_its_training(device, made_up, monkeypatch, tmp_path):
    """What is written into a file, read by the command line, gives the same settings."""
    import typer
    from typer.testing import CliRunner

    config = tiny(method="mgail", seed=4, colour=WHITE_NOISE, clone_weight=(0.2, 0.1))
    found = []
    monkeypatch.setattr(command_line, "train_driver", lambda *given, **how: found.append((*given, how)) or tmp_path)
    app = typer.Typer()
    app.command()(command_line.main)
    words = command_of(made_up, config, device).split()[3:]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert found[0][1] == config
    assert found[0][0] == Source("data", Path("tables"))
    assert found[0][-1]["device"] == device


@pytest.mark.parametrize(
    ("words", "message"),
    [([], "one of --data"), (["--data", "nowhere"], "nowhere"), (["--ngsim", "a", "--highd", "b"], "one of")],
)
def test_the_command_line_says_what_is_missing(words, message, tmp_path):
    import typer
    from typer.testing import CliRunner

    app = typer.Typer()
    app.command()(command_line.main)
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "run")])
    assert result.exit_code == 2
    assert message in result.output


def test_the_shared_command_line_trains_drivers(made_up, tmp_path, capsys):
    words = ["train-drivers", "--data", "tables", "--method", "gail", "--updates", "1", "--json"]
    assert rare_envs_command([*words, "--out", str(tmp_path / "run")]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert read_provenance(answer["driver"]).kind == answer["method"] == "gail"


@pytest.mark.parametrize("words", [["--data", "t", "--method", "sac"], ["--data", "nowhere"], []])
def test_the_shared_command_line_refuses_in_one_line(words, tmp_path, capsys):
    assert rare_envs_command(["train-drivers", *words, "--out", str(tmp_path / "run")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
