"""Bad input of every command: exit code 2 and one line that says what is wrong, before any simulation."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

import rare_envs
from tests.rare_envs.study.fitted_files import write_fitted
from tests.rare_envs.study.refusals import FOLLOWING, Cli, assert_refused, in_file

RISK = ("risk", "idm", "--base", "cut_in=cut_in.json", "--base", "hard_brake=hard_brake.json", "--max-sim", 300)
ESTIMATE, TRAIN, EXPORT = ("estimate", FOLLOWING), ("train-ego", FOLLOWING), ("export", "run", "--out")
CUDA, CUDA_FILE = ("--device", "cuda:99"), in_file(device="cuda:99")
REFUSED: tuple[tuple[tuple[Any, ...], tuple[str, ...]], ...] = (
    (("estimat",), ("estimat", "See rare-envs --help.")),
    (("list", "--loud"), ("--loud", "See rare-envs list --help.")),
    (("list", "egoss"), ("did you mean 'egos'", "environments, bases, methods, egos")),
    (("list", "merge"), ("merge", "such as CutIn")),
    (("list", "cut_inn"), ("did you mean 'cut_in'?",)),
    (("estimate",), ("Expected a scenario: rare-envs estimate CutIn",)),
    ((*ESTIMATE, "--ego"), ("--ego", "See rare-envs estimate --help.")),
    ((*ESTIMATE, "--max-sim", "ten"), ("'--max-sim'", "such as 10000 or 1e4", "See rare-envs estimate")),
    ((*ESTIMATE, "--max-sim", 0), ("--max-sim",)),
    ((*ESTIMATE, "--workers", 0), ("--workers",)),
    ((*ESTIMATE, "--gamma", "nan"), ("--gamma", "nan")),
    ((*ESTIMATE, "--target-cov", 0), ("--target-cov",)),
    ((*ESTIMATE, "--measure", "tcc"), ("'tcc'", "'ttc'")),
    ((*ESTIMATE, "--config", "missing.yaml"), ("missing.yaml",)),
    ((*ESTIMATE, "--seed", -1), ("--seed",)),
    ((*ESTIMATE, *in_file(replicates=0)), ("replicates",)),
    ((*ESTIMATE, *in_file(on_error="stop")), ("on_error",)),
    ((*ESTIMATE, "--mehtod", "adss"), ("--mehtod", "--method")),
    ((*ESTIMATE, "--method", "addss"), ("'adss'", "mc")),
    ((*ESTIMATE, "--base", "us102"), ("'us101'", "highway")),
    ((*ESTIMATE, "--base", "broken.json"), ("broken.json", "JSON")),
    ((*ESTIMATE, "--drivers", "mgial"), ("did you mean 'mgail'",)),
    ((*ESTIMATE, "--observation", "sonar"), ("'features', 'lidar'",)),
    ((*ESTIMATE, *in_file(also_under=",")), ("one base or more",)),
    ((*ESTIMATE, *in_file(also_under="i24,i24")), ("each once",)),
    ((*ESTIMATE, "--out", "a_file"), ("a_file",)),
    ((*ESTIMATE, "--ego", "corrupt.zip"), ("corrupt.zip",)),
    ((*ESTIMATE, "--ego", "egos_here:wrong_space"), ("101", "(11,)")),
    ((*ESTIMATE, "--ego", "egos_here:wrong_shape"), ("(2, 2)",)),
    ((*ESTIMATE, "--ego", "egos_here:raising"), ("division by zero",)),
    ((*ESTIMATE, "--ego", "egos_here:raising", *in_file(on_error="bound")), ("zero. on_error: bound", "comes before")),
    ((*ESTIMATE, "--ego", "egos_here:exiting_when_asked"), ("SystemExit(7)",)),
    ((*ESTIMATE, "--max-p", 0.1, "--max-rate", 1), ("max-p or",)),
    ((*ESTIMATE, "--max-rate", 0), ("above 0",)),
    ((*ESTIMATE, "--max-rate", 1, "--gamma", 1), ("no rate per km: --gamma 1",)),
    ((*ESTIMATE, "--max-p", 2), ("Expected --max-p above 0",)),
    ((*ESTIMATE, "--max-p", 0.1, "--confidence", 0.4), ("0.4",)),
    ((*ESTIMATE, "--confidence", 95), ("above 0 and below 1, got 95.0: 95 % is 0.95",)),
    ((*ESTIMATE, "--assume-traffic"), ("--assume-traffic together with a limit; see Gate",)),
    ((*ESTIMATE, *in_file(time_limit=5)), ("Expected time_limit together with workers",)),
    ((*ESTIMATE, "--workers", 2, *in_file(address="auto")), ("Expected address together with executor ray",)),
    ((*ESTIMATE, "--workers", 2, *in_file(memory_limit=0)), ("a number of GiB above 0, got 0",)),
    ((*ESTIMATE, *in_file(executor="dask")), ("executor to be local or ray, got 'dask'",)),
    ((*ESTIMATE, *CUDA_FILE), ("'cuda:99' is not here", "take 'cpu'")),
    (("estimate", "merge-v0", "--base", "us101"), ("has no --base", "CutIn-v0")),
    (("estimate", "highway-fast-v0", *in_file(weather=True)), ("has no --weather",)),
    (("estimate", "highway-fast-v0", "--config", "limit.yaml"), ("has no --max-p",)),
    (("estimate", "highway-fast-v0", "--measure", "braking"), ("'braking'",)),
    (("compare", "idm", "human", FOLLOWING), ("the same x, got 3 and", "estimate each by itself")),
    (("compare", "idm", "idm", FOLLOWING, *in_file(collisions="none")), ("none",)),
    ((*ESTIMATE, "--plan", "--target-cov", "nan"), ("Expected --target-cov to be a number above 0",)),
    (("estimate", "nowhere", "--plan"), ("There is no folder", "nowhere' of a run. Unknown environment")),
    (("estimate", ".", "--plan"), ("No finished run in",)),
    (("estimate", "run", "--plan", "--method", "ce"), ("--method has no use here",)),
    ((*ESTIMATE, "--plan", "--out", "new"), ("--out has no use here",)),
    (("estimate", "run"), ("is a folder: rare-envs resume run",)),
    (("plan", "run"), ("it is rare-envs estimate SCENARIO --plan",)),
    (("bases",), ("list bases",)),
    (("serve-ego", "idm"), ("python -m agents.remote",)),
    (("train-drivers",), ("python -m training.imitation",)),
    (("export-ego", "a.zip"), ("rare-envs export EGO.zip",)),
    ((*ESTIMATE, "--chunk", 64), ("No such option --chunk: put chunk: 64 into a file for --config.",)),
    ((*ESTIMATE, "--no-ensemble-run"), ("put ensemble_run: false into a file for --config.",)),
    ((*ESTIMATE, "--weather"), ("put weather: true into a file for --config.",)),
    (("risk", "idm", *CUDA_FILE), ("'cuda:99' is not here",)),
    (("risk", "idm", "--assume-traffic"), ("--assume-traffic together with a limit",)),
    ((*RISK[:1], "imd", *RISK[2:]), ("idm",)),
    ((*RISK, "--scenario", "merge"), ("merge",)),
    (("risk", "idm", "--scenario", "highway"), ("No base of highway is of a site",)),
    (("risk", "idm", "--scenario", "CutIn,car-following"), ("would count twice",)),
    ((*RISK, "--base", "hard_brake=mine.json"), ("several for 'hard_brake'",)),
    ((*RISK, "--sites", "us101-test"), ("no site", "'us101'", "cut_in=us101-test")),
    (("risk", "idm", "--base", "cut_in=broken.json"), ("broken.json", "JSON")),
    (("risk", "idm", "--sites", "i80"), ("hard_brake has no base of the site 'i80' (it has us101): --base hard_br",)),
    ((*RISK, "--base", "highway=x.json"), ("of highway, which is none of cut_in, hard_brake",)),
    ((*RISK, "--out", "a_file"), ("a_file",)),
    ((*TRAIN, "--algo", "poo"), ("'ppo'",)),
    ((*TRAIN, "--steps", "2.5"), ("'--steps': expected a whole number, such as 10000 or 1e4",)),
    ((*TRAIN, "--steps", "10", *CUDA), ("'cuda:99' is not here",)),
    ((*TRAIN, "--out", "."), ("folder",)),
    (("train-ego",), ("--from-failures",)),
    (("train-ego", "--from-failures", "nowhere", "--base", "us101"), ("leave --base",)),
    (("export", "idm", "b.onnx"), ("files that end in .zip, are exported; got 'idm'.",)),
    (("export", "ego.zip", "b.zip"), ("Expected a file that ends in .onnx, got 'b.zip'.",)),
    (("export", "ego.zip", "corrupt.zip/b.onnx"), ("the folder 'corrupt.zip': there is a file of that name",)),
    (("export", "nowhere.zip", "b.onnx"), ("No ego at 'nowhere.zip'",)),
    (("fit", "--out", "bases", "--highd", "a", "--tgsim", "b"), ("Expected one of --data, --ngsim",)),
    (
        ("fit", "--out", "bases", "--highd", "nowhere"),
        ("no folder nowhere; expected the data folder of highD",),
    ),
    (("fit", "--out", "bases", "--ngsim", "none.csv"), ("Cannot read none.csv",)),
    (("fit", "--out", "bases", "--data", "none"), ("Cannot read events from",)),
    (("fit", "--out", "bases", "--highd", "a", "--scenario", "overtaking"), ("Unknown environment 'overtaking'",)),
    (("fit", "--out", "bases", "--highd", "a", "--name", "a/b"), ("Expected --name",)),
    (("check-ego", "idm", "rare_envs/CutIn-v9"), ("rare_envs/CutIn-v0",)),
    (("check-ego", "no_such.zip", FOLLOWING), ("No ego at 'no_such.zip'; in that folder: corrupt.zip",)),
    (("check-ego", "process:no_such.onnx", FOLLOWING), ("No ego at 'no_such.onnx': the folder '.' has no .onnx",)),
    (("check-ego", "imitatoin", FOLLOWING), ("Unknown ego 'imitatoin' (did you mean 'imitation'?)",)),
    (("replay", "run", "--failure", -1), ("Expected a failure from 0 to",)),
    (("replay", "run", "--out", "clip.mp4"), ("ends in .gif",)),
    (("replay", "run", "--out", "run/result.json/clip.gif"), ("there is a file of that name",)),
    (("replay", "run", "--all", "--out", "a.gif"), ("--all without --out",)),
    (("replay", "run", "--all", "--failure", 0), ("--all without --failure",)),
    (("report", "run", "--figures", "bmp"), ("Expected --figures svg, pdf, png",)),
    ((*EXPORT, "a.gif"), ("ends in .xosc",)),
    ((*EXPORT, "a.xml"), ("ends in .xosc for openscenario", "--format commonroad writes")),
    ((*EXPORT, "a.xosc", "--format", "opensenario"), ("openscenario",)),
    ((*EXPORT, "a.xosc", "--format", "carla", "--ego", "recorded"), ("free",)),
    ((*TRAIN, "--out", "corrupt.zip"), ("There is 'corrupt.zip' already", "--force")),
    (("export", "corrupt.zip", "kept/a.onnx"), ("'kept/a.onnx' already",)),
    (("replay", "run", "--out", "old.gif"), ("'old.gif' already",)),
    (("report", "run", "--out", "old.gif"), ("'old.gif' already",)),
    ((*EXPORT, "old.xosc"), ("'old.xodr' already",)),
    (("corpus", "run", "--ego", "idm", "--junit", "old.gif"), ("'old.gif' already",)),
    (("corpus", "run"), ("--ego", "See rare-envs corpus run --help.")),
    (("corpus", "run", "--ego", "idm"), ("There is no corpus",)),
    (("corpus", "run", "--ego", "idm", "--junit", "run/result.json/a.xml"), ("Cannot make the folder",)),
    (("corpus", "add", "run", "--limit", 0), ("at least one",)),
    (("corpus", "add", "nowhere"), ("nowhere",)),
    (("export", "nowhere", "--out", "crash.xosc"), ("nowhere",)),
    (("fit", "--out", "bases"), ("--highd",)),
)


@pytest.mark.filterwarnings("ignore:.*changed since the run")
def test_bad_input_is_one_line_and_leaves_no_file(
    cli: Cli, here: Path, finished_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def simulated(*_: Any) -> None:
        raise AssertionError("a simulation was started")

    monkeypatch.setattr(rare_envs.DrivingProblem, "evaluate", simulated)
    shutil.copytree(finished_run, here / "run")
    for name in ("cut_in", "hard_brake"):
        write_fitted(here / f"{name}.json", name)
    (here / "limit.yaml").write_text("max_p: 0.001\n", encoding="utf-8")
    (here / "kept").mkdir()
    for name in ("kept/a.onnx", "old.gif", "old.xodr"):
        (here / name).write_text("mine", encoding="utf-8")
    before = set(here.iterdir())
    for words, said in REFUSED:
        refused = cli(*words)
        assert refused.exit_code == 2, (words, refused.output)
        assert_refused(refused, *said)
        if words[0] == "estimate" and len(words) == 4 and words[3] in (-1, 0):
            assert not re.search(r"[a-z]_[a-z]", refused.stderr)  # the option, not its name in Python
    assert set(here.iterdir()) - {here / "__pycache__"} == before and (here / "a_file").read_text() == "mine"
