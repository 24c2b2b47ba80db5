"""The commands `estimate` and `plan`: what they print, exit codes and options; HighwayEnv and learned drivers too."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers its ids)
import numpy as np
import pytest
import typer
from stable_baselines3 import DQN

import agents
import rare_envs
import samplers
from rare_envs.interop.problem import HighwayEnvProblem
from rare_envs.study.arguments import GATE_CODES, KEYS, ExecutorOptions
from rare_envs.study.cli.app import EXAMPLES, app, list_examples
from rare_envs.study.cli.estimate import ESTIMATE_FILE
from rare_envs.study.run_folder import CRASH, read_failures
from samplers.executors import LocalProcesses
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, act_after, assert_refused, in_file, interrupt


def test_a_doubtful_number_says_so_and_exits_with_3(cli: Cli, safe: str) -> None:
    words = ("estimate", FOLLOWING, "--method", "adss", "--max-sim", 2000, "--base", safe)
    result = cli(*words)
    assert result.exit_code == 3
    assert "\nWarning      " in result.stdout
    assert ", converged" not in cli(*words, "--details").stdout
    answer = cli(*words, "--json")
    assert answer.exit_code == 3 and json.loads(answer.stdout)["doubtful"] is True


@pytest.mark.usefixtures("full_pictures")
def test_an_upper_bound_by_plain_monte_carlo_is_an_answer(cli: Cli, safe: str, tmp_path: Path) -> None:
    result = cli(*SMALL, "--base", safe, "--out", tmp_path / "run")
    assert result.exit_code == 0
    assert "Warning" not in result.stdout
    assert "none in 2,000 simulations; below 0.0018 (95 %)\n" in result.stdout
    assert "failure modes rarer than 0.0015 (95 %) that the search did not find\n" in result.stdout
    written = json.loads((tmp_path / "run" / "result.json").read_text())
    assert written["doubtful"] is False and written["doubts"] == []
    assert written["interval"][1] == pytest.approx(1 - 0.025 ** (1 / 2000))
    assert (tmp_path / "run" / "answer.png").stat().st_size > 1_000


def test_the_answer_is_short_unless_details_are_asked_for(cli: Cli, risky: str, tmp_path: Path) -> None:
    words = (*SMALL, "--base", risky)
    short, long = cli(*words).stdout, cli(*words, "--details").stdout
    lines = short.splitlines()
    assert [line[:13].rstrip() for line in lines if line[:1].strip()][1:] == (
        ["Crashes", "Limited by", "Left out", "Rate", "Crash", "May miss", "Next"]
    )
    assert len(lines) <= 12 and max(map(len, lines)) < 100 and "c.o.v. 0." not in short
    assert long.startswith(short) and "c.o.v. 0." in long
    assert lines[-1] == "Next         --details (method, relative error, all intervals, remarks)"
    text = cli(*words, "--out", tmp_path / "a b").stdout
    assert f"Next         rare-envs report '{tmp_path / 'a b'}'" in text
    assert json.loads((tmp_path / "a b" / "result.json").read_text())["text"] == lines[:-1]


def test_what_is_unusual_in_the_most_likely_failure_is_named(finished_run: Path) -> None:
    result = json.loads((finished_run / "result.json").read_text())
    shown = " ".join(" ".join(result["text"]).split())
    named = re.findall(r"(ego at|lead at|gap) (-?[\d.]+) (?:m|m/s) \(usually (-?[\d.]+) to (-?[\d.]+)\)", shown)
    failure = result["failures"][0]["parameters"]
    for words, value, low, high in named:
        name = {"ego at": "ego_speed", "lead at": "lead_speed"}.get(words, words)
        assert float(value) == pytest.approx(failure[name], rel=0.05)
        assert not float(low) <= failure[name] <= float(high)
    assert bool(named) != ("all parameters in their usual range" in shown)


def test_a_gate_is_one_sentence_and_recorded(cli: Cli, risky: str, tmp_path: Path) -> None:
    """About one scenario in sixty fails."""
    result = cli(*SMALL, "--base", risky, "--max-p", 0.2, "--confidence", 0.99, "--out", tmp_path / "run")
    assert result.exit_code == GATE_CODES["passes"] == 0
    last = result.stdout.splitlines()[-1]
    assert last.startswith("GATE passes (exit code 0): p below 0.2 (99 % confidence, upper limit ")
    assert "98 % interval" in result.stdout
    recorded = json.loads((tmp_path / "run" / "result.json").read_text())
    assert recorded["question"]["max_p"] == 0.2 and recorded["gate"]["decision"] == "passes"
    answer = json.loads(cli(*SMALL, "--base", risky, "--max-p", 0.001, "--json").stdout)
    assert (answer["gate"]["decision"], answer["gate"]["confidence"]) == ("fails", 0.95)
    assert answer["confidence"] == 0.9  # no 0.8999999999999999


def test_an_ego_that_fails_on_the_way_is_one_line(cli: Cli, here: Path, risky: str) -> None:
    words = (*SMALL[:-1], 300, "--base", risky, "--ego", "egos_here:nan_when_close", "--out")
    assert_refused(cli(*words, here / "new" / "run"), "NaN")
    assert not (here / "new").exists()
    (here / "old").mkdir()
    assert_refused(cli(*words, here / "old"), "NaN")
    assert (here / "old").exists()


def test_weather_on_the_command_line(cli: Cli) -> None:
    words = ("estimate", "rare_envs/CutIn-v0", "--observation", "camera+lidar", "--method", "mc")
    found = json.loads(cli(*words, "--max-sim", 40, *in_file(weather=True, horizon=1), "--json").stdout)["question"]
    assert found["weather"] is True and found["observation"] == "camera+lidar"


def test_a_plan_from_pilots_and_one_from_a_folder(
    cli: Cli, risky: str, safe: str, finished_run: Path, tmp_path: Path
) -> None:
    options = ("--base", risky, "--method", "mc", *in_file(horizon=4), "--plan", "--max-sim", 2000)
    answer = json.loads(cli("estimate", FOLLOWING, *options, "--target-cov", 0.05, "--json").stdout)
    (planned,) = answer["runs"]
    assert planned["method"] == "mc" and planned["n_sim"] > 2000 and planned["seconds"] > 0.0
    shutil.copytree(finished_run, tmp_path / "run")
    text = cli("estimate", tmp_path / "run", "--plan", "--target-cov", 0.05).stdout
    assert f"{planned['n_sim']:,} simulations" in text and "--target-cov 0.05" in text  # the same seed, the same pilot
    none = cli("estimate", FOLLOWING, "--base", safe, "--method", "mc", "--plan", "--max-sim", 200)
    assert none.exit_code == 2 and none.stdout == ""
    assert "found no failure" in none.stderr.splitlines()[-1]  # behind the bar


def test_options_name_an_executor() -> None:
    assert ExecutorOptions(workers=3, memory_limit=2.0).make() == LocalProcesses(3, memory_limit=2.0**31)
    assert ExecutorOptions(executor="local").make() == LocalProcesses()
    ray = ExecutorOptions(executor="ray", address="auto", time_limit=9.0, memory_limit=1.0)
    assert ray.make() == samplers.executors.RayCluster("auto", time_limit=9.0, memory_limit=2.0**30)


def commands(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each command and group by its name, a group's before those in it."""
    for name, found in group.commands.items():
        yield f"{prefix}{name}", found
        if hasattr(found, "commands"):
            yield from commands(found, f"{prefix}{name} ")


def test_every_help_page_has_examples_of_options_that_its_command_takes(cli: Cli) -> None:
    tree = dict(commands(typer.main.get_command(app)))
    pages = {page: list_examples(page) for page in ("", *tree)}
    assert {line for lines in pages.values() for line in lines} >= set(EXAMPLES.split("\n")) - {""}
    for page, lines in pages.items():
        shown = cli(*page.split(), "--help").stdout
        assert lines
        for line in lines:
            assert f"    {line}\n" in shown and len(line) <= 96
            program, name, *words = shlex.split(line)
            if f"{name} {words[0] if words else ''}" in tree:
                name = f"{name} {words.pop(0)}"
            assert program == "rare-envs"
            tree[name].make_context(name, words)  # parses; raises where an option is none of the command's


def test_summaries_are_whole_and_no_line_is_wider_than_the_terminal(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in (("--help",), ("corpus", "--help")):
        shown = cli(*words).stdout
        assert max(map(len, shown.splitlines())) <= 80
        assert "...\n" not in shown.partition("Commands:")[2]
    assert "and show its most likely failure." in " ".join(cli("--help").stdout.split())


ALIKE = "base drivers observation action method max-sim confidence seed assume-traffic workers config trust out force"
"""Options of `estimate`, `risk` and `compare`."""


COMMANDS = "list train-ego check-ego estimate risk compare resume fit report replay export corpus".split()


def test_help_is_in_sections_as_wide_as_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    pages, listed = dict[str, str](), dict[str, list[str]]()
    assert sorted(dict(commands(typer.main.get_command(app)))) == sorted([*COMMANDS, "corpus add", "corpus run"])
    for name in COMMANDS:
        with pytest.raises(SystemExit):
            app([name, "--help"], prog_name="rare-envs")
        pages[name] = capsys.readouterr().out
        listed[name] = re.findall(r"(?m)^  (--[\w-]+)", pages[name])
    assert max(map(len, listed.values())) == len(listed["estimate"]) <= 24
    assert 100 < max(map(len, pages["estimate"].splitlines())) <= 120
    for title in ("Ego and scenario", "Question", "Precision and budget", "Gate", "Run", "Output"):
        assert f"\n{title}:\n" in pages["estimate"]
    for name in ("estimate", "risk", "compare"):
        assert {f"--{word}" for word in f"{ALIKE} details json".split()} <= {*listed[name]}
    told = " ".join(pages["estimate"].split()).partition("further settings: ")[2].partition(". --")[0].split(", ")
    options = {option.removeprefix("--").replace("-", "_") for option in listed["estimate"]}
    assert {*KEYS} == (options & {*KEYS}) | {*told} | {"max_ratio"} and not options & {*told}


def test_a_confidence_is_that_of_the_interval(cli: Cli, risky: str) -> None:
    found = [json.loads(cli(*SMALL, "--base", risky, "--confidence", c, "--json").stdout) for c in (0.8, 0.99)]
    (low, high), (wider_low, wider_high) = (each["interval"] for each in found)
    assert [each["confidence"] for each in found] == [0.8, 0.99] and wider_low < low < high < wider_high


@pytest.mark.parametrize(("limit", "decision"), [(1.5, "passes"), (0.5, "fails"), (1.01, "undecided")])
def test_a_limit_of_a_comparison_is_how_much_worse_b_is(limit: float, decision: str, cli: Cli, risky: str) -> None:
    """Of one ego with itself p_B / p_A is 1; a longer time headway of B makes it less."""
    words = ("compare", "idm", "idm?time_headway=1.51", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 4000)
    done = cli(*words, "--max-ratio", limit)
    assert done.exit_code == GATE_CODES[decision], done.output
    assert done.stdout.splitlines()[-1].startswith(f"GATE {decision} (exit code {GATE_CODES[decision]}): ")


@pytest.mark.slow
def test_one_file_of_settings_serves_all_three(cli: Cli, risky: str) -> None:
    """With the settings of each alone: a key that a command does not use is refused by its name."""
    file = in_file(env="car-following", base=risky, method="mc", max_sim=600, seed=3, horizon=2, chunk=500)
    one = json.loads(cli("estimate", *file, "--json").stdout)["question"]
    pair = json.loads(cli("compare", "idm", "idm", *file, "--json").stdout)["question"]
    names = ("env_id", "base", "method", "max_sim", "seed", "horizon", "chunk")
    assert [one[name] for name in names] == [pair[name] for name in names] == [FOLLOWING, risky, "mc", 600, 3, 2.0, 500]
    words = in_file(scenario="CutIn", base="i80", method="mc", max_sim=300, seed=3)
    risk = json.loads(cli("risk", "idm", *words, "--json").stdout)
    assert list(risk["scenarios"]) == ["cut_in"] and risk["scenarios"]["cut_in"]["base"] == "i80"
    assert_refused(cli("compare", "idm", "idm", *in_file(env="CutIn", replicates=2)), "does not use", "'replicates'")
    assert_refused(cli("risk", "idm", *in_file(sead=2)), "unknown key 'sead' (did you mean 'seed'?)")


@pytest.mark.slow
def test_an_estimate_in_highway_env_is_resumed(cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = "estimate highway-fast-v0 --ego egos_here:idle --method ss --max-sim 150".split()
    words += in_file(horizon=1)
    whole = json.loads(cli(*words, "--json").stdout)
    with monkeypatch.context() as patch:
        act_after(100, interrupt, patch, HighwayEnvProblem, "evaluate")
        assert "go on with: rare-envs resume run\n" in cli(*words, "--out", "run").stderr
    assert json.loads(cli("resume", "run", "--json").stdout)["p"] == whole["p"]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy for HighwayEnv's environments, untrained."""
    path = tmp_path_factory.mktemp("egos") / "ego.zip"
    env: Any = gym.make("highway-fast-v0")
    DQN("MlpPolicy", env, policy_kwargs={"net_arch": [4]}, buffer_size=10, seed=0, device="cpu").save(path)
    return path


def test_a_policy_from_there_is_estimated_there(cli: Cli, saved: Path, tmp_path: Path) -> None:
    words = ("estimate", "highway-fast-v0", "--ego", saved, "--method", "mc", "--max-sim", 4, *in_file(horizon=2))
    result = cli(*words, "--out", tmp_path / "run", "--json")
    assert result.exit_code in (0, 3), result.output
    answer = json.loads(result.stdout)
    assert (answer["n_sim"], answer["env_id"], answer["ego"]) == (4, "highway-fast-v0", str(saved))
    assert samplers.Estimate.load(tmp_path / "run" / ESTIMATE_FILE).p == answer["p"]
    assert_refused(cli(*words, "--out", tmp_path / "run"), "--force")
    text = cli(*words).stdout
    assert text.startswith(f"{saved} in highway-fast-v0\nP[f <= 0] ") and "what it holds fixed is held" in text


def test_a_policy_of_another_config_is_estimated_in_it(cli: Cli, tmp_path: Path) -> None:
    """The message names the option that helps; a file may be JSON or YAML, and names no code by itself."""
    config = {"observation": {"type": "Kinematics", "vehicles_count": 7}, "vehicles_count": 3}
    files = {"wide.json": json.dumps(config), "wide.yaml": "observation: {type: Kinematics, vehicles_count: 7}"}
    files |= {"twice.yaml": "a: &a {b: 1}\nc: *a", "list.json": "[]", "code.json": '{"other_vehicles_type": "mine.It"}'}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    path = tmp_path / "wide.zip"
    env: Any = gym.make("highway-fast-v0", config=config)
    DQN("MlpPolicy", env, policy_kwargs={"net_arch": [4]}, buffer_size=10, seed=0, device="cpu").save(path)
    words = ("estimate", "highway-fast-v0", "--ego", path, "--method", "mc", "--max-sim", 2, "--json")
    assert_refused(cli(*words, *in_file(horizon=1)), "env_config: FILE")
    for name in ("wide.json", "wide.yaml"):
        answer = json.loads(cli(*words, *in_file(horizon=1, env_config=str(tmp_path / name))).stdout)
        assert (answer["n_sim"], answer["env_config"]["observation"]) == (2, config["observation"])
    for name, said in (("twice.yaml", "*name"), ("list.json", "keys and values"), ("code.json", "--trust")):
        assert_refused(cli(*words, *in_file(env_config=str(tmp_path / name))), said)
    assert_refused(
        cli("estimate", "CutIn-v0", *in_file(env_config=str(tmp_path / "wide.json"))), "environment of HighwayEnv"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("full_pictures")
def test_the_highway_end_to_end(cli: Cli, tmp_path: Path) -> None:
    """Blocks of x in every place where parameters are told, and drivers and horizon in the record."""
    words = "Highway-v0 --measure lidar_ttc --gamma 1 --ego mgail --drivers gail --method mc --max-sim 256".split()
    result = cli("estimate", *words, *in_file(horizon=2, noise="fixed"), "--details", "--out", tmp_path)
    assert result.exit_code in (0, 3), result.output
    assert "the drivers' noise is one fixed sequence" in result.stdout
    assert max(map(len, result.stdout.splitlines())) < 200
    lines = {line.split()[0]: line for line in result.stdout.splitlines() if line.strip()}
    assert len(lines["speed"].partition("m/s")[0].split()) == 1 + 6
    assert "404 values" in lines["weights"]
    answer = json.loads((tmp_path / "result.json").read_text())
    asked, likely = answer["question"], answer["failures"][0]["parameters"]
    kept = [asked[name] for name in ("drivers", "ego", "horizon", "noise", "observation")]
    assert kept == ["gail", "mgail", 2.0, "fixed", "lidar"]
    assert {name: len(likely[name]) for name in likely} == {"s": 6, "t": 6, "heading": 6, "speed": 6, "weights": 404}
    header = (tmp_path / "failures.csv").read_text().splitlines()[0].split(",")
    assert header[:2] == ["s[0]", "s[1]"] and header[-3 - len(CRASH) :] == ["speed[5]", "f", "log_p0", *CRASH]
    found = read_failures(tmp_path)
    for name, values in likely.items():
        np.testing.assert_array_equal(found[name][0], np.float32(values) if name == "weights" else values)
    world = {name: asked[name] for name in ("measure", "noise", "drivers", "horizon")}
    problem = rare_envs.DrivingProblem(asked["env_id"], ego=agents.load_ego("mgail"), **world)
    x = np.concatenate([found[name] for name in problem.space.names], axis=1)
    np.testing.assert_allclose(problem.evaluate(x), found["f"], atol=1e-3)  # products round by batch size
    np.testing.assert_allclose(problem.base.log_prob(x), found["log_p0"], atol=0.1)
    assert (tmp_path / "crash.png").stat().st_size > 5_000
