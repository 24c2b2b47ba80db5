"""The other commands: listing, egos, finished runs and risk."""

from __future__ import annotations

import json
import sys
import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers its ids)
import numpy as np
import pytest
from PIL import Image, ImageSequence
from stable_baselines3 import PPO

import agents
import rare_envs
import samplers
import training.fit.recordings as fitting
from rare_envs.scenarios.hard_brake import HARD_BRAKE
from rare_envs.scenarios.registry import SCENARIOS, find_scenario
from rare_envs.startup import advise_install
from rare_envs.study.cli.egos_and_runs import FAILS
from rare_envs.study.cli.listing import TITLES
from rare_envs.study.corpus import read_corpus
from rare_envs.study.ego_check import VERDICTS
from rare_envs.study.plots import CURVES_HEIGHT
from rare_envs.study.run_folder import read_failures
from tests.rare_envs.study.fitted_files import fitted_entries, write_fitted
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused, in_file


def test_list_shows_what_there_is(cli: Cli) -> None:
    shown = cli("list", "all").stdout
    entries = json.loads(cli("list", "--json").stdout)
    assert list(entries["environments"]) == list(SCENARIOS)
    assert list(entries["methods"]) == list(samplers.methods.METHODS)
    for env_id, environment in entries["environments"].items():
        space = rare_envs.DrivingProblem(env_id).space
        assert environment["vehicles"] == rare_envs.parallel_env(env_id).possible_agents
        listed = environment["parameters"]
        assert [each["name"] for each in listed] == list(space.names[: len(listed)])
        learned = rare_envs.DrivingProblem(env_id, drivers="mgail").space
        added = [(each["name"], each["size"]) for each in environment["of_learned_drivers"]]
        assert added == list(zip(learned.names, learned.sizes, strict=True))[len(listed) :]
        for end, none in (("low", -np.inf), ("high", np.inf)):
            ends = [none if each[end] is None else each[end] for each in listed]
            expected = np.repeat(ends, [each["size"] for each in listed])
            assert expected.tolist() == getattr(space, end)[: len(expected)].tolist()
        assert environment["kinematics_id"] in gym.registry
    assert all(name in gym.registry for name in entries["highway_env"])
    assert "weights (404 values), noise (1,020 values)" in " ".join(shown.split())
    named = (*SCENARIOS, *samplers.methods.METHODS, *agents.files.SHIPPED_DRIVERS)
    for name in (*named, "us101", "okelly2018", "lidar_ttc"):
        assert name in shown


def test_all_names_fit_a_screen(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    entries, shown = json.loads(cli("list", "--json").stdout), cli("list").stdout
    assert len(shown.splitlines()) <= 24
    names = [*entries["environments"], *entries["highway_env"], *(name for kind in TITLES for name in entries[kind])]
    names += [each["name"] for environment in entries["environments"].values() for each in environment["parameters"]]
    assert set(" ".join(names).replace(",", " ").split()) <= set(shown.replace(",", " ").split())
    weighted = [line for line in shown.splitlines() if "weights" in line]
    assert any("Highway-v0" in line for line in weighted) and not any("CutIn" in line for line in weighted)


def test_one_kind_is_explained_alone(cli: Cli) -> None:
    whole = json.loads(cli("list", "all", "--json").stdout)
    bases = json.loads(cli("list", "bases", "--json").stdout)["bases"]
    cut_in = {
        kind: {"rare_envs/CutIn-v0": of["rare_envs/CutIn-v0"]}
        for kind, of in (("environments", whole["environments"]), ("bases", bases))
    }
    for what, there, absent, expected in (
        ("egos", "rule-based driver", "lateral_offset", {"egos": whole["egos"]}),
        ("CutIn-v0", "us101-closing", "CarFollowing", cut_in),
        ("cut-in-v0", "lateral_offset", "CarFollowing", cut_in),
    ):
        shown = cli("list", what).stdout
        assert there in shown and absent not in shown
        assert json.loads(cli("list", what, "--json").stdout) == expected
    assert list(json.loads(cli("list", "environments", "--json").stdout)) == ["environments", "highway_env"]


def test_traffic_models_are_listed_in_short_lines(cli: Cli) -> None:
    shown = {spelling: cli("list", spelling).stdout for spelling in ("CutIn", "cut-in", "rare_envs/CutIn-v1")}
    assert len(set(shown.values())) == 1 and "\nus101 (default)\n" in shown["CutIn"]
    everything = cli("list", "bases").stdout
    assert all(f"Traffic models of {env_id}\n" in everything for env_id in SCENARIOS)
    assert max(map(len, (everything + shown["CutIn"]).splitlines())) < 100


def test_bases_tell_events_site_fit_and_frequency(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    bases = {
        "us101": fitted_entries("hard_brake"),
        "plain": fitted_entries(
            "hard_brake", refits=None, events=None, family=None, frequency=None, checks=None, provenance=None
        ),
    }
    monkeypatch.setitem(SCENARIOS.data, "rare_envs/HardBrake-v0", replace(HARD_BRAKE, bases=bases))
    text = " ".join(cli("list", "rare_envs/HardBrake-v0").stdout.split())
    assert "us101 (default) fitted to 42 events of 40 scenes, 30 refits" in text
    assert "site site of hard_brake, 2005-06-15" in text
    assert "fit BIC 1,086.8, held-out log likelihood -14.60 per event" in text
    assert "7.4 per hour, 0.19 per km: 42 in 5.64 h (events of a test)" in text
    assert "recorded / expected: TTC < 5 s 2 / 7.5" in text
    assert "plain frequency not known, no rate per hour or km: nobody counted" in text


def test_an_ego_is_trained_on_with_the_failures_of_its_runs(cli: Cli, risky: str, tmp_path: Path) -> None:
    words = ("--steps", 40, "--num-envs", 8, "--json")
    ego, on, runs = tmp_path / "ego.zip", tmp_path / "on.zip", [tmp_path / "first", tmp_path / "second"]
    assert cli("train-ego", FOLLOWING, "--algo", "a2c", "--out", ego, *words).exit_code == 0
    for seed, run in enumerate(runs):
        estimated = cli(*SMALL, "--base", risky, "--ego", ego, "--seed", 7 + seed, "--out", run)
        assert estimated.exit_code in (0, 3), estimated.output
    found = [len((run / "failures.csv").read_text().splitlines()) - 1 for run in runs]
    both = [part for run in runs for part in ("--from-failures", run)]
    trained = cli("train-ego", *both, "--failure-share", 0.5, "--out", on, *words)
    assert trained.exit_code == 0, trained.output
    answer = json.loads(trained.stdout)
    expected = {"env_id": FOLLOWING, "algo": "a2c", "base": risky, "retrained": str(ego), "failures": sum(found)}
    assert answer.items() >= {**expected, "failure_share": 0.5}.items()
    one = ("train-ego", "--from-failures", runs[0], "--out", on, "--force")
    assert f"--base {risky} --seed 8" in " ".join(cli(*one, *words[:-1]).stdout.split())
    assert_refused(cli(*one, "--algo", "ppo"), "Expected --algo a2c", "'ppo'")
    assert_refused(cli("train-ego", "rare_envs/CutIn-v0", *one[1:]), f"Expected SCENARIO {FOLLOWING}")
    assert_refused(cli(*one, "--failure-share", 1), "share of failures above 0 and below 1")


def test_an_ego_is_trained_in_all_scenarios_of_risk(cli: Cli, tmp_path: Path) -> None:
    ego = tmp_path / "ego.zip"
    words = ("--steps", 16, "--num-envs", 8, "--algo", "a2c", "--out", ego, *in_file(horizon=0.5))
    printed = cli("train-ego", "all", *words, "--base", "us101").stdout
    assert printed.endswith(f"risk {ego} --base us101 --config FILE, with horizon: 0.5 in the file\n")
    answer = json.loads(cli("train-ego", "HardBrake-v0", "CutIn-v1", *words, "--force", "--shares", "--json").stdout)
    assert answer["env_id"] == ["rare_envs/HardBrake-v0", "rare_envs/CutIn-v1"]


def test_the_files_that_were_fitted_are_the_answer(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: dict[str, Any] = {}
    file, names = tmp_path / "car_following_own.json", ["ego_speed", "lead_speed", "gap"]

    def fit(recordings: Any, out: Path, **options: Any) -> list[Path]:
        asked.update(options, kind=recordings.kind_and_path()[0], between=recordings.between)
        print("progress")
        file.write_text(json.dumps({"names": names}))
        return [out / file.name]

    monkeypatch.setattr(fitting, "fit_bases", fit)
    words = ("--i24", "a.json", "--between", 1, 2, "--scenario", "car_following", "--refits", 3, "--out", tmp_path)
    answer = cli("fit", *words, "--json")
    assert json.loads(answer.stdout) == {"bases": [str(file)]}
    assert "progress" in answer.stderr
    given = {"kind": "i24", "between": (1.0, 2.0), "scenarios": ["car_following"], "n_refits": 3}
    assert asked == {**given, "cut_gaps": False, "name": "own", "seed": 0, "progress": True, "force": False}
    monkeypatch.setitem(SCENARIOS, "mine/LongFollowing-v0", replace(find_scenario("car_following"), horizon=20.0))
    for known in ("CarFollowing-v0", "SCENARIO"):
        assert cli("fit", *words, "--force").stdout == f"{file}: rare-envs estimate {known} --base {file}\n"
        names[:] = ["of none"]


def test_an_ego_is_checked_in_the_traffic_that_is_asked_for(cli: Cli) -> None:
    findings = json.loads(cli("check-ego", "idm", FOLLOWING, "--base", "nowhere", "--json").stdout)["findings"]
    assert findings[-1]["status"] == "fail"
    assert "nowhere" in findings[-1]["found"]
    refused = cli("check-ego", "https://example.org/ego.zip", FOLLOWING)
    assert refused.exit_code == 2 and "remote place" in refused.stdout and VERDICTS[2] in refused.stdout


def test_an_ego_is_exported(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, out = tmp_path / "ego.zip", tmp_path / "a.onnx"
    PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, seed=0, policy_kwargs={"net_arch": [4]}).save(model)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "onnx", None)
        said = f"Exporting needs onnx and onnxruntime: {advise_install('onnx')}."
        assert_refused(cli("export", model, out), said)
    assert not out.exists()
    pytest.importorskip("onnxruntime", reason="the extra onnx is optional")
    pytest.importorskip("onnx", reason="the extra onnx is optional")
    report = json.loads(cli("export", model, out, "--json").stdout)
    assert report["onnx"] == str(out) and report["largest_difference"] <= report["tolerance"]
    assert cli("export", model, "--out", out, "--force").stdout == (
        f"Wrote {out}: its actions differ by {report['largest_difference']:.1e} at most on 1,440 random observations.\n"
    )


def test_a_failure_of_a_run_is_shown(cli: Cli, run: Path, tmp_path: Path) -> None:
    result = cli("replay", run, "--failure", 1, "--out", "clip.gif", "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["f"] == answer["f_recorded"] == read_failures(run)["f"][1] == -1.0
    assert (answer["crash"]["kind"], answer["crash"]["vehicles"]) == ("rear_end", [0, 1])
    with Image.open("clip.gif") as film:
        assert film.size == (800, 160 + 48 + CURVES_HEIGHT)
        length = sum(frame.info["duration"] for frame in ImageSequence.Iterator(film))
    assert length == pytest.approx(2000 * answer["seconds"] + 1000, abs=1)  # half speed, and the end stays 1 s
    words = cli("replay", run, "--out", "worst.png").stdout
    n_found = json.loads((run / "result.json").read_text())["n_failures"]
    first = f"Failure 0 of {n_found} found in "
    assert all(said in words for said in (first, "ego_speed", "the ego rear-ends the lead, closing at", "worst.png"))


def test_a_kind_of_crash_is_shown_by_its_number(cli: Cli, run: Path) -> None:
    (mode,) = json.loads((run / "result.json").read_text())["modes"]
    assert json.loads(cli("replay", run, "--mode", 1, "--json").stdout)["failure"] == mode["failure"]
    assert json.loads(cli("export", run, "a.xosc", "--mode", 1, "--json").stdout)["failure"] == mode["failure"]
    assert_refused(cli("replay", run, "--mode", 2), "Expected --mode from 1 to 1, got 2")
    assert_refused(cli("replay", run, "--mode", 1, "--failure", 0), "--failure or --mode, not both")


def test_all_failures_replay_and_another_ego_takes_them(cli: Cli, run: Path) -> None:
    answer = json.loads(cli("replay", run, "--all", "--json").stdout)
    assert answer["same"] == len(answer["trials"]) > 20
    other = cli("replay", run, "--all", "--ego", "egos_here:coasting", "--json")
    assert other.exit_code == FAILS and json.loads(other.stdout)["failed"] == len(answer["trials"])
    one = cli("replay", run, "--ego", "egos_here:coasting")
    assert one.exit_code == 0
    assert one.stdout.splitlines()[-1] == "The ego was egos_here:coasting; that of the run had f = -1."
    table = (run / "failures.csv").read_text()
    (run / "failures.csv").write_text(table.replace(",-1.0,", ",-0.5,", 1))  # f of the first
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        changed = cli("replay", run, "--all")
    assert "Not what the run in 'run' wrote" in changed.stderr and "failures.csv." in changed.stderr
    assert changed.exit_code == 3 and changed.stdout.count("\n") == 2


def test_from_a_run_to_a_regression_test(cli: Cli, run: Path) -> None:
    assert cli("corpus", "add", run).stdout.startswith("Added 20 of 20")
    same = cli("corpus", "run", "--ego", "idm", "--junit", "out.xml", "--json")
    answer = json.loads(same.stdout)
    assert (same.exit_code, answer["passed"], answer["failed"], answer["error"]) == (FAILS, 0, 20, 0)
    assert ET.parse("out.xml").getroot()[0].get("failures") == "20"
    lines = cli("corpus", "run", "--ego", "egos_here:coasting").stdout.splitlines()
    assert lines[0].startswith("egos_here:coasting fails in 20 of 20 scenarios") and len(lines) == 21
    for stored in read_corpus(Path("corpus")):  # thresholds below any f that there is
        strict = replace(stored, world={**stored.world, "gamma": -2.0})
        Path("corpus", f"{stored.key}.json").unlink()
        Path("corpus", f"{strict.key}.json").write_text(strict.to_json())
    result = cli("corpus", "run", "--ego", "idm")
    assert result.exit_code == 0 and result.stdout.startswith("idm fails in 0 of 20 scenarios")


FEW = ("--method", "mc", "--max-sim", 300)
BRAKE = ("estimate", "rare_envs/HardBrake-v0", *FEW)


def test_estimate_prints_the_rate_beside_people(cli: Cli, here: Path) -> None:
    base = write_fitted(here / "fitted.json", "hard_brake")
    short = " ".join(cli(*BRAKE, "--base", base).stdout.split())
    assert " per million km (" in short and "; people in brakings not counted " in short
    assert f"human driver model not measured in {Path(base).name} " in short
    text = " ".join(cli(*BRAKE, "--base", base, "--details").stdout.split())
    assert "per event per million km people in them human model brakings 0.19" in text
    assert "from 0.19 brakings per km; " in text
    data = json.loads(cli(*BRAKE, "--base", base, "--json").stdout)
    assert data["rate"]["per_million_km"] == pytest.approx(1e6 * 42 / 218 * data["p"])


def test_estimate_says_in_one_line_why_there_is_no_rate(cli: Cli, here: Path) -> None:
    base = write_fitted(here / "fitted.json", "hard_brake")
    for words, said in (
        (("--base", base, "--gamma", "1"), "--gamma 1 counts other events"),
        (("--base", write_fitted(here / "b.json", "hard_brake", frequency=None)), "nobody counted"),
    ):
        shown = " ".join(cli(*BRAKE, *words).stdout.split())
        assert said in shown.partition("Rate no rate per km: ")[2]


def test_p_under_other_bases(cli: Cli, here: Path) -> None:
    """A near one is answered, a far one refused with its reason; one that is not there before any simulation."""
    base, near, far = (write_fitted(here / f"{k}.json", "hard_brake", shift=k) for k in (0.0, 0.2, 8.0))
    words = (*BRAKE, "--base", base, *in_file(also_under=f"{near}, {far}"))
    one, other = json.loads(cli(*words, "--json").stdout)["other_bases"]
    assert one["refused"] == "" and one["interval"][0] < one["p"] < one["interval"][1]
    assert "effective" in other["refused"] or "worth" in other["refused"]
    text = " ".join(cli(*words).stdout.split())
    assert f"with {near} " in text and f"with {far} not known: " in text
    assert_refused(cli(*BRAKE, "--base", base, *in_file(also_under="nowhere")), "nowhere")
