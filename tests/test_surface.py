"""The fixed surface as a checklist: each name, keyword, option, info key, command and exit code once."""

import contextlib
import io
import json
import re
import runpy
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import agents
import rare_envs
import samplers
import training

CAR_FOLLOWING, CUT_IN, HARD_BRAKE, HIGHWAY = (
    f"rare_envs/{name}-v0" for name in ("CarFollowing", "CutIn", "HardBrake", "Highway")
)
PARAMETERS = {
    CAR_FOLLOWING: ("ego_speed", "lead_speed", "gap"),
    CUT_IN: ("ego_speed", "cut_in_speed", "lead_speed", "cut_in_gap", "lead_gap", "lateral_offset"),
    HIGHWAY: ("s", "t", "heading", "speed", "weights", "noise"),
}
METHODS = {
    **{"auto": "Auto", "mc": "MonteCarlo", "is": "ImportanceSampling", "ce": "CrossEntropy", "series": "Series"},
    **{"ice": "ImprovedCrossEntropy", "ss": "SubsetSimulation", "adss": "AdaptiveSubsetSimulation"},
    **{"two-stage": "TwoStage", "surrogate": "Surrogate"},
}
COMMANDS = {
    "list": "--json",
    "train-ego": "--algo --steps --out --seed --num-envs --json",
    "check-ego": "--base --drivers --observation --action --json",
    "estimate": "--ego --method --base --measure --gamma --seed --max-sim --target-cov --max-p --workers --out --force "
    "--json --details --config --drivers --observation --action --plan --confidence --max-rate",
    "risk": "--method --max-sim --seed --out --json",
    "compare": "--method --max-sim --seed --out --json",
    "resume": "--workers --json",
    "fit": "--data --ngsim --highd --scenario --name --refits --out --json",
    "report": "--out --events --figures",
    "replay": "--failure --out --ego --all",
    "export": "--out --failure --format --ego",
    "corpus": "",
}


# ---- environments


def test_the_ids_and_their_parameters() -> None:
    for env_id, names in PARAMETERS.items():
        env = gym.make(env_id)
        assert env.unwrapped.space.names == names
        obs, info = env.reset(seed=0)
        assert env.observation_space.contains(obs)
        assert tuple(info["scenario"]) == names and info["x"].shape == (env.unwrapped.space.dim,)
    assert {*PARAMETERS, HARD_BRAKE} <= set(rare_envs.ENV_IDS)
    assert gym.make(HARD_BRAKE).unwrapped.space.names[:2] == ("speed", "gap")


def test_a_scenario_space_has_names_units_bounds_and_a_base_distribution() -> None:
    space = gym.make(CUT_IN).unwrapped.space
    assert space.units == ("m/s", "m/s", "m/s", "m", "m", "m")
    x = space.sample(5, np.random.default_rng(0))
    assert np.all(space.low <= x) and np.all(x <= space.high)
    assert space.log_prob(x) == pytest.approx(space.base.log_prob(x))
    assert space.from_standard_normal(space.to_standard_normal(x)) == pytest.approx(x)


@pytest.mark.parametrize(
    "keywords",
    [
        *({"observation": kind} for kind in ("features", "lidar", "camera", "kinematics")),
        *({"action": kind} for kind in ("continuous", "discrete", "meta")),
        {"measure": "clearance", "horizon": 4.0, "dt": 0.2, "base": "i80"},
        {"drivers": "mgail", "noise": "fixed"},
    ],
    ids=str,
)
def test_the_keywords_of_make(keywords: dict[str, Any]) -> None:
    env = gym.make(CUT_IN, **keywords)
    obs, _ = env.reset(seed=1)
    assert env.observation_space.contains(obs)
    obs, reward, _, truncated, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(obs) and np.isfinite(reward) and not truncated


def test_an_episode_fills_info() -> None:
    env = gym.make(CUT_IN)
    _, info = env.reset(seed=0, options={"cut_in_gap": 4.0, "cut_in_speed": 5.0, "ego_speed": 30.0})
    assert info["scenario"]["cut_in_gap"] == 4.0 and not info["collision"]
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
        over = terminated or truncated
    assert info["collision"] and info["measure"] == -1.0 and info["min_ttc"] == 0.0
    assert isinstance(info["collision_type"], str)


def test_a_scenario_comes_back_from_its_x() -> None:
    env = gym.make(HIGHWAY)
    _, drawn = env.reset(seed=3)
    _, info = env.reset(options={"x": drawn["x"]})
    assert np.array_equal(info["x"], drawn["x"])
    _, info = env.reset(seed=3, options={"speed": np.full(6, 20.0)})
    assert np.array_equal(info["scenario"]["speed"], np.full(6, 20.0))


def test_many_scenarios_are_one_simulation() -> None:
    batch = gym.make_vec(CUT_IN, num_envs=8, vectorization_mode="vector_entry_point")
    assert batch.reset(seed=0)[0].shape[0] == 8
    assert batch.step(np.zeros((8, 2), np.float32))[1].shape == (8,)
    assert gym.make_vec(CUT_IN, num_envs=2).unwrapped.__class__ is batch.unwrapped.__class__
    assert training.sb3_vec_env(CUT_IN, num_envs=8).reset().shape[0] == 8


def test_every_vehicle_is_an_agent() -> None:
    env = rare_envs.parallel_env(CUT_IN)
    observed, _ = env.reset(seed=0)
    assert set(observed) == {"ego", "cutter", "lead"}
    _, rewards, _, _, _ = env.step({"ego": np.zeros(2, np.float32)})
    assert set(rewards) == set(observed)


# ---- problems and egos


def test_a_driving_problem_is_a_problem() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego="idm", measure="ttc", base="us101", noise=True, horizon=6.0)
    assert isinstance(problem, samplers.Problem) and problem.dim == 6
    assert problem.evaluate(problem.base.sample(3, np.random.default_rng(0))).shape == (3,)


def test_noise_is_part_of_x_or_fixed_or_absent() -> None:
    dims = [rare_envs.DrivingProblem(HIGHWAY, noise=noise).dim for noise in (True, "fixed", False)]
    assert dims[0] > dims[1] == dims[2] == 428


@pytest.mark.parametrize(
    ("name", "env_id"),
    [
        ("idm", CUT_IN),
        ("human", CUT_IN),
        ("imitation", CAR_FOLLOWING),
        pytest.param("vision", CUT_IN, marks=pytest.mark.slow),
    ],
)
def test_egos_by_name(name: str, env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id, ego=agents.load_ego(name), horizon=1.0)
    assert np.all(np.isfinite(problem.evaluate(problem.base.sample(2, np.random.default_rng(0)))))


# ---- samplers


@pytest.mark.parametrize(("package", "n"), [(samplers, 22), (rare_envs, 10), (agents, 10), (training, 4)])
def test_a_package_shows_the_names_of_most_users(package: ModuleType, n: int) -> None:
    assert dir(package) == sorted(package.__all__) and len(package.__all__) == n
    assert all(hasattr(package, name) for name in package.__all__)
    page = (Path(__file__).parents[1] / "docs/reference/index.md").read_text().split(f"::: {package.__name__}\n")[1]
    listed = re.findall(r"^        - (\w+)$", page.partition(":::")[0], re.MULTILINE)
    whole = package in (samplers, rare_envs)  # in the order of use where they are many
    assert sorted(listed) == (dir(package) if whole else [])


def test_a_name_of_a_module_is_said_to_be_there() -> None:
    with pytest.raises(AttributeError, match=r"'StandardNormal'; it is samplers\.distributions\.StandardNormal$"):
        _ = samplers.StandardNormal
    with pytest.raises(AttributeError, match=r"has no attribute 'plan_runs'$"):
        _ = samplers.plan_runs


def test_methods_have_names_and_defaults() -> None:
    assert set(METHODS) <= set(samplers.methods.METHODS)
    for name, cls in METHODS.items():
        assert isinstance(samplers.methods.get_method(name), getattr(samplers, cls))


def test_estimate_takes_its_arguments_and_fills_an_estimate() -> None:
    result = samplers.estimate(
        samplers.FunctionProblem(lambda u: 2.0 - u[:, 0], dim=2),
        samplers.AdaptiveSubsetSimulation(),
        gamma=0.0,
        seed=1,
        max_sim=6000,
        target_cov=0.2,
        confidence=0.9,
        replicates=2,
        on_error="bound",
        progress=False,
    )
    assert result.interval[0] < 0.02275 < result.interval[1]
    assert (result.confidence, result.gamma, result.seed, result.method.name) == (0.9, 0.0, 1, "adss")
    assert result.n_sim <= 6000 and result.cov > 0 and result.gain > 0
    assert str(result.status) and result.trace and result.base_uncertainty is None
    assert isinstance(result.warnings, tuple) and {"p", "interval", "n_sim"} <= set(result.to_dict())
    worst = result.failures
    assert worst.x.shape[1] == 2 and np.all(worst.f <= 0) and np.all(np.diff(worst.log_p0) <= 0)


# ---- the command line


@contextlib.contextmanager
def signals_restored() -> Iterator[None]:
    """Give back the handlers of signals, which a command line that ends ignores."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def run(*words: object) -> tuple[int, str, str]:
    """Run `python -m rare_envs` in this process; return exit code, standard output and standard error."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, signals_restored():
        patch.setattr(sys, "argv", ["rare-envs", *map(str, words)])
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as end:
            runpy.run_module("rare_envs", run_name="__main__")
    return int(end.value.code or 0), out.getvalue(), err.getvalue()


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_its_options(command: str) -> None:
    code, out, _ = run(command, "--help")
    assert code == 0
    assert not [option for option in COMMANDS[command].split() if option not in out]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that used most options."""
    folder = tmp_path_factory.mktemp("study") / "run"
    config = folder.with_name("run.yaml")
    config.write_text(f"env: {CUT_IN}\nmethod: mc\ngamma: 0.5\ncore: torch\n")
    code, out, err = run(
        *f"estimate --ego idm --base us101 --measure ttc --seed 1 --max-sim 3000 --workers 1 --out {folder} --force "
        f"--json --details --config {config} --max-p 0.9 --assume-traffic".split()
    )
    assert code == 0 and 0 < json.loads(out)["p"] < 0.9, err
    return folder


def test_a_run_is_replayed_exported_and_kept(study: Path, tmp_path: Path) -> None:
    assert run("replay", study, "--failure", "0")[0] == 0
    assert run("replay", study, "--all", "--json")[0] == 0
    for form, name in (("openscenario", "crash.xosc"), ("carla", "carla.xosc"), ("commonroad", "crash.xml")):
        assert run("export", study, "--out", tmp_path / name, "--format", form)[0] == 0
        assert (tmp_path / name).stat().st_size
    assert run("corpus", "add", study, "--corpus", tmp_path / "corpus", "--limit", 2)[0] == 0
    assert run("corpus", "run", "--ego", "idm", "--corpus", tmp_path / "corpus")[0] in (0, 4)
    assert rare_envs.load_study(study)


@pytest.mark.parametrize(("limit", "n", "expected"), [("0.5", 1000, 0), ("1e-4", 1000, 4), ("1e-2", 100, 5)])
def test_a_gate_passes_fails_or_is_undecided(limit: str, n: int, expected: int) -> None:
    gate = f"estimate {CUT_IN} --method mc --measure ttc --gamma 1.0 --assume-traffic --max-sim {n} --max-p {limit}"
    assert run(*gate.split())[0] == expected


@pytest.mark.parametrize("line", ["bogus", f"estimate {CUT_IN} --max-p 2", "replay nowhere"])
def test_bad_input_is_one_line_and_exit_code_2(line: str) -> None:
    code, out, err = run(*line.split())
    assert (code, out) == (2, "")
    assert len(err.strip().splitlines()) == 1 and "Traceback" not in err


def test_risk_is_summed_over_scenarios() -> None:
    code, out, _ = run(*"risk idm --max-sim 500 --method adss --json".split())
    assert code in (0, 3) and json.loads(out)
