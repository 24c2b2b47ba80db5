"""Trainings in miniature: resumed as if never stopped, rates that fall, commands that repeat them."""

import dataclasses
import inspect
import json
from pathlib import Path

import pytest
import torch

from agents import load_driver, read_provenance
from agents.learned.coloured_noise import WHITE_NOISE
from agents.learned.networks import head_weights
from tests.training.data.recordings import simulate, write_ngsim
from tests.training.imitation.synthetic_scenes import scenes
from training.imitation import train as command_line
from training.imitation.algorithms.config import Config
from training.imitation.datasets import Source, split_end
from training.imitation.fit import make_learner, prepare_data, train_learner
from training.imitation.run_folder import command_of, read_training_settings, train_driver

TINY = Config(
    updates=6,
    epochs=1,
    batch=64,
    pools=2,
    scenes=2,
    horizon=(3, 5),
    age=(6, 9),
    critic_batch=32,
    warm_up=2,
    ppo_batch=40,
)


@pytest.fixture(scope="module")
def data():
    return prepare_data(scenes())


def tiny(**settings):
    return dataclasses.replace(TINY, **settings)


def weights(policy):
    return torch.cat([value.flatten() for value in policy.state_dict().values()])


@pytest.mark.parametrize(
    "settings", [{"method": "gail"}, {"method": "mgail"}, {"learned_model": True}], ids=["gail", "mgail", "model"]
)
def test_a_killed_training_resumes_to_the_same_weights(data, settings, tmp_path):
    config = tiny(**settings)
    whole = train_learner(make_learner(data, config))
    stopped = make_learner(data, config)

    class Killed(Exception):
        pass

    save = stopped.save

    def save_and_die(path):
        save(path)
        raise Killed

    stopped.save = save_and_die
    with pytest.raises(Killed):
        train_learner(stopped, tmp_path, every=3)
    assert stopped.update == 3
    resumed = train_learner(make_learner(data, config), tmp_path, every=3)
    assert torch.equal(weights(resumed), weights(whole))
    assert not torch.equal(weights(make_learner(data, config).policy), weights(whole))


def test_seeds_decide_the_weights(data):
    first, second, third = (train_learner(make_learner(data, tiny(method="bc", seed=seed))) for seed in (1, 1, 2))
    assert torch.equal(weights(first), weights(second))
    assert not torch.equal(weights(first), weights(third))


def test_nothing_is_drawn_from_the_global_generator(data):
    before = torch.get_rng_state()
    train_learner(make_learner(data, tiny(method="gail", updates=1)))
    assert torch.equal(torch.get_rng_state(), before)


def test_learning_rates_fall_after_the_schedules():
    config = Config(updates=1000, anneal=0.7, last_rate=0.1)
    assert [config.rate_factor(update) for update in (0, 700, 850, 1000)] == pytest.approx([1.0, 1.0, 0.55, 0.1])


def test_the_learner_uses_them(data):
    learner = make_learner(data, tiny(updates=2, anneal=0.5, policy_rate=3e-4, critic_rate=4e-4))
    train_learner(learner)
    (group,) = learner.policy_optimiser.param_groups
    assert group["lr"] == pytest.approx(3e-4)
    learner.update = 2
    learner.set_rates()
    assert learner.critic_optimiser.param_groups[0]["lr"] == pytest.approx(4e-5)
    assert learner.policy_optimiser.param_groups[0]["lr"] == pytest.approx(3e-5)


@pytest.fixture
def made_up(monkeypatch):
    """A source that reads nothing from files."""
    monkeypatch.setattr("training.imitation.run_folder.load_scenes", lambda source: (scenes(2), scenes(3)[2:]))
    return Source("data", command_line.Path("somewhere/tables"))


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


def test_the_command_line_has_every_setting():
    options = inspect.signature(command_line.main).parameters
    names = {option.name for option in dataclasses.fields(Config)} - {"colour"} | {"noise"}
    assert names <= set(options)
    for option in dataclasses.fields(Config):
        if option.name in options:
            default = options[option.name].default
            assert getattr(default, "value", default) == option.default, option.name


def test_a_command_repeats_its_training(made_up, monkeypatch, tmp_path):
    """What is written into a file, read by the command line, gives the same settings."""
    import typer
    from typer.testing import CliRunner

    config = tiny(method="mgail", seed=4, learned_model=True, colour=WHITE_NOISE, clone_weight=(0.2, 0.1))
    found = []
    monkeypatch.setattr(command_line, "train_driver", lambda *given, **how: found.append(given) or tmp_path)
    app = typer.Typer()
    app.command()(command_line.main)
    words = command_of(made_up, config).split()[3:]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert found[0][1] == config
    assert found[0][0] == Source("data", command_line.Path("tables"))


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


def test_the_end_of_each_recording_is_kept_for_tests():
    named = [dataclasses.replace(scenes(1)[0], name=f"{side}-{start}") for side in "ab" for start in range(10)]
    learn, test = split_end(named)
    assert [scene.name for scene in test] == ["a-8", "a-9", "b-8", "b-9"]
    assert len(learn) == 16
    assert split_end(named[:1])[1] == ()


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "sac"},
        {"method": "gail", "learned_model": True},
        {"updates": 0},
        {"epochs": -1},
        {"pools": 0},
        {"horizon": (15, 0)},
        {"clone_weight": (0.1, 0.0)},
        {"policy_rate": float("nan")},
        {"edge_weight": -1.0},
        {"discount": 1.1},
        {"anneal": 0.0},
        {"last_rate": 2.0},
    ],
)
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=f"Expected {next(iter(settings))}|with learned_model"):
        Config(**settings)


def test_a_source_is_of_a_known_kind():
    with pytest.raises(ValueError, match="ngsim"):
        Source("waymo", command_line.Path())


def test_scenes_without_followers_are_refused():
    from tests.training.imitation.synthetic_scenes import scene

    with pytest.raises(ValueError, match="Nobody follows"):
        prepare_data([scene(vehicles=3)])
    with pytest.raises(ValueError, match="got none"):
        prepare_data([])


def test_logs_go_to_tensorboard(data, tmp_path):
    pytest.importorskip("tensorboard", reason="the extra logs is optional")
    train_learner(make_learner(data, tiny(updates=2)), tmp_path, log=True)
    assert list(tmp_path.glob("events.out.*"))


def test_logs_without_tensorboard_are_refused(data, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ValueError, match=r"rare-envs\[logs\]"):
        train_learner(make_learner(data, tiny(updates=1)), tmp_path, log=True)
    with pytest.raises(ValueError, match=r"rare-envs\[logs\]"):  # before the data are even looked for
        train_driver(Source("data", tmp_path / "nowhere"), TINY, tmp_path / "run", log=True)


def rare_envs_command(words):
    from rare_envs.study.cli.app import app

    with pytest.raises(SystemExit) as stop:
        app(words, prog_name="rare-envs")
    return stop.value.code


def test_the_shared_command_line_trains_drivers(made_up, tmp_path, capsys):
    words = ["train-drivers", "--data", "tables", "--method", "bc", "--out", str(tmp_path / "run"), "--json"]
    assert rare_envs_command(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert read_provenance(answer["driver"]).kind == answer["method"] == "bc"


@pytest.mark.parametrize("words", [["--data", "t", "--method", "sac"], ["--data", "nowhere"], []])
def test_the_shared_command_line_refuses_in_one_line(words, tmp_path, capsys):
    assert rare_envs_command(["train-drivers", *words, "--out", str(tmp_path / "run")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_training_that_could_not_begin_does_not_block_its_folder(tmp_path):
    """A typo in the path of the data, and the same folder again with the right one."""
    out = tmp_path / "run"
    with pytest.raises(ValueError, match=r"no ngsim_us101_scenes\.parquet in the folder 'nope'"):
        train_driver(Source("data", Path("nope")), Config(method="bc", epochs=1), out)
    assert not out.exists()
    with pytest.raises(ValueError, match="Cannot read"):
        train_driver(Source("ngsim", tmp_path / "nope.csv"), Config(method="bc", epochs=1), out)
    write_ngsim(tmp_path / "mine.csv", simulate(seed=1))
    source = Source("ngsim", tmp_path / "mine.csv")
    assert train_driver(source, Config(method="bc", epochs=1), out, measured=False).exists()
