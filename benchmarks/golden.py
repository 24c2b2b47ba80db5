"""Golden record: what the public surface answers, kept by one version of the code and compared with another.

    PYTHONPATH=TREE python -P benchmarks/golden.py record --out DIR     # by the code in the folder TREE
    PYTHONPATH=TREE python -P benchmarks/golden.py compare DIR          # a line for each group and each difference

A case is a function that returns arrays by name; the record keeps them, and the scenarios x that f was asked for.
Verdicts: the same bits; within tolerance (1e-5; estimates of p three joint standard errors; commands the same exit code
and no key of the JSON answer lost, with another message); DIFFERENT, which makes the exit code 1. `--only WORD` takes
the cases whose group or name has the word.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import runpy
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import agents
import rare_envs
import samplers

Values = dict[str, np.ndarray]

SCRIPTS = ("rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0", "rare_envs/HardBrake-v0")
HIGHWAY = "rare_envs/Highway-v0"
CUT_IN = "rare_envs/CutIn-v0"
TOLERANCE = 1e-5
"""Relative difference that rounding in another order may make."""
ROWS = 10_000
SLOW_ROWS = 200
CAMERA_ROWS = 8
MEASURES = (
    "ttc lidar_ttc ttc_2d mttc thw drac required_deceleration btn near_crash ttb pet rss_longitudinal rss_lateral "
    "rss_margin clearance tet tit margin golden_ego:least_speed"
).split()
EGO_MODULE = """
import numpy as np

class make_ego:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        seen = np.tanh(np.asarray(observation).reshape(len(observation), -1).sum(axis=1))
        return np.stack([-0.5 + 0.3 * seen, 0.0 * seen], axis=1).astype(np.float32), None

def least_speed(moment):
    return moment.state.speed[:, 0]
"""


@dataclass(frozen=True)
class Case:
    """Something to ask: its group and name, the function that asks, and the rule of the comparison."""

    group: str
    name: str
    ask: Callable[[], Values]
    rule: str = "bits"


@dataclass
class Record:
    """The folder of a record."""

    folder: Path
    writes: bool

    def path(self, *words: str) -> Path:
        """Return the path of a file whose name has the words."""
        return self.folder / (re.sub(r"[^\w.+-]+", "_", "-".join(words)) + ".npz")

    def scenarios(self, problem: Any, n: int, *words: str) -> np.ndarray:
        """Return the n scenarios x (n, d) kept under the words and the dimension; draw and keep them if it writes."""
        path = self.path("x", *words, str(problem.dim), str(n))
        if self.writes and not path.exists():
            np.savez(path, x=problem.base.sample(n, np.random.default_rng(0)))
        return np.load(path)["x"]


def ask_f(record: Record, n: int, base: str | None = None, **question: Any) -> Values:
    """Return f of n scenarios for the keyword arguments of a `DrivingProblem`."""
    if isinstance(ego := question.get("ego"), str):
        question["ego"] = agents.load_ego(ego)
    problem = rare_envs.DrivingProblem(base=base, **question)
    words = (question["env_id"], base or "", short(str(question.get("drivers", ""))))
    return {"f": problem.evaluate(record.scenarios(problem, n, *words))}


def egos(record: Record, env_id: str) -> dict[str, str]:
    """Return the specs of egos by their kind; the files were trained in the cut-in."""
    named = ("idm", "human", "imitation", "idm?time_headway=1.0", "noisy:imitation", "golden_ego:make_ego")
    files = ("ppo.zip", "dqn.zip", "ppo.onnx") if env_id == CUT_IN else ()
    return {**{name: name for name in named}, **{name: str(record.folder / name) for name in files}}


@cache
def newest_mgail() -> str:
    """Return `mgail`; where older drivers stand as well, the file of the newest of them."""
    newest = Path(agents.__file__).parent / "data" / "mgail5.safetensors"
    return str(newest) if newest.exists() else "mgail"


def short(name: str) -> str:
    """Return the name of a driver in the record."""
    return Path(name).stem.rstrip("5")


def cases_of_egos(record: Record) -> Iterator[Case]:
    """Yield f by scenario and ego, by torch; and by compiled rollouts where these can be had."""
    for env_id in SCRIPTS:
        for kind, ego in egos(record, env_id).items():
            n = ROWS if kind.startswith("idm") else 2000
            ask = partial(ask_f, record, n, env_id=env_id, ego=ego, core="torch")
            yield Case("f by ego, torch", f"{env_id} {kind}", ask)
        for kind in {"idm", "idm?time_headway=1.0", "ppo.zip", "dqn.zip"} & set(egos(record, env_id)):
            ask = partial(ask_f, record, ROWS, env_id=env_id, ego=egos(record, env_id)[kind], core="numba")
            yield Case("f by ego, numba", f"{env_id} {kind}", ask)
        for ego in ("gail", newest_mgail()):
            ask = partial(ask_f, record, SLOW_ROWS, env_id=env_id, ego=ego, core="torch")
            yield Case("f by ego, torch", f"{env_id} {short(ego)}", ask)
    yield Case("f by ego, torch", "vision", partial(ask_f, record, CAMERA_ROWS, env_id=CUT_IN, ego="vision"))
    yield Case("f by ego, torch", "tcp", partial(ask_served, record))
    inner = f"process:{record.folder / 'ppo.zip'}"
    yield Case("f by ego, torch", "process", partial(ask_f, record, 2000, env_id=CUT_IN, ego=inner, core="torch"))


def cases_of_traffic(record: Record) -> Iterator[Case]:
    """Yield f among drivers: learned ones and rules, noise in three ways, egos on the highway."""
    for drivers in ("gail", newest_mgail(), "idm", "idm+mobil"):
        for env_id in (*SCRIPTS, HIGHWAY):
            ask = partial(ask_f, record, SLOW_ROWS, env_id=env_id, drivers=drivers, core="torch")
            yield Case("f among drivers", f"{env_id} {short(drivers)}", ask)
    among = {"env_id": HIGHWAY, "drivers": newest_mgail(), "core": "torch"}
    for ego in ("human", "imitation", newest_mgail(), "golden_ego:make_ego"):
        ask = partial(ask_f, record, SLOW_ROWS, ego=ego, **among)
        yield Case("f among drivers", f"highway, ego {short(ego)}", ask)
    for noise in ("fixed", False):
        yield Case("f among drivers", f"noise {noise}", partial(ask_f, record, SLOW_ROWS, noise=noise, **among))
    yield Case("f among drivers", "any collision", partial(ask_f, record, SLOW_ROWS, collisions="any", **among))
    compiled = partial(ask_f, record, 100, **{**among, "core": "numba"})
    yield Case("f among drivers, numba", "highway", compiled)


def ask_served(record: Record) -> Values:
    """Return f of an ego in another program."""
    with serve(record.folder / "ppo.zip") as address:
        return ask_f(record, 2000, env_id=CUT_IN, ego=address, core="torch")


@contextlib.contextmanager
def serve(spec: Path) -> Iterator[str]:
    """Serve an ego at a free port of this machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    command = [sys.executable, "-m", "agents.remote", str(spec), "--bind", address]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        process.stderr.readline()  # it says when it serves
        yield address
    finally:
        process.terminate()
        process.wait()


def cases_of_measures(record: Record) -> Iterator[Case]:
    """Yield f by scenario and measure, with the IDM; some on the highway."""
    for env_id in SCRIPTS:
        for measure in (*MEASURES, "stl:always (gap > 2)"):
            ask = partial(ask_f, record, 2000, env_id=env_id, measure=measure, core="torch")
            yield Case("f by measure", f"{env_id} {measure}", ask)
    for measure in ("ttc", "lidar_ttc", "clearance", "rss_margin", "pet"):
        ask = partial(ask_f, record, 100, env_id=HIGHWAY, drivers="idm", measure=measure, core="torch")
        yield Case("f by measure", f"highway {measure}", ask)


def bases_of(env_id: str) -> list[str]:
    """Return the names of the base distributions of a scenario."""
    return list(json.loads(run_command(f"list {env_id} --json")[1])["environments"][env_id]["bases"])


def ask_base(record: Record, env_id: str, base: str) -> Values:
    """Return draws, log densities and standard normal coordinates of a base, and f at kept scenarios."""
    problem = rare_envs.DrivingProblem(env_id, base=base, drivers=None if env_id != HIGHWAY else "idm", core="torch")
    x = record.scenarios(problem, 1000, env_id, base, "base")
    u = problem.base.to_standard_normal(x)
    drawn = problem.base.sample(1000, np.random.default_rng(1))
    back = problem.base.from_standard_normal(np.random.default_rng(2).standard_normal((500, problem.dim)))
    values = {"draws": drawn, "log_prob": problem.base.log_prob(x), "u": u, "back": back}
    return {**values, "f": problem.evaluate(x[: 1000 if env_id != HIGHWAY else 100])}


def cases_of_bases(record: Record) -> Iterator[Case]:
    """Yield all base distributions."""
    for env_id in (*SCRIPTS, HIGHWAY):
        for base in bases_of(env_id):
            yield Case("base distributions", f"{env_id} {base}", partial(ask_base, record, env_id, base))


FUNCTIONS: dict[str, tuple[int, Callable[[np.ndarray], np.ndarray]]] = {
    "plane": (2, lambda u: 3.5 - u.sum(axis=1) / 2**0.5),
    "plane of 20": (20, lambda u: 3.5 - u.sum(axis=1) / 20**0.5),
    "two modes": (2, lambda u: 2.2 - np.minimum(np.abs(u[:, 0]), u[:, 1])),
    "parabola": (2, lambda u: 3.3 + 0.2 * u[:, 0] ** 2 - u[:, 1]),
    "two planes": (6, lambda u: np.minimum(3.5 - u[:, 0], 3.8 + u[:, 1:].sum(axis=1) / 5**0.5)),
}
METHODS = ("auto", "two-stage", "surrogate", "mc", "is", "ce", "ice", "ss", "adss")


def ask_estimates(make_problem: Callable[[], Any], **arguments: Any) -> Values:
    """Return what `samplers.estimate` says for three seeds."""
    found = [samplers.estimate(make_problem(), seed=seed, **arguments) for seed in range(3)]
    columns = {
        "p": [each.p for each in found],
        "low": [each.interval[0] for each in found],
        "high": [each.interval[1] for each in found],
        "cov": [np.inf if each.cov is None else each.cov for each in found],
        "n_sim": [each.n_sim for each in found],
        "failures": [len(each.failures.f) for each in found],
    }
    return {name: np.array(values, float) for name, values in columns.items()}


def cases_of_estimates(record: Record) -> Iterator[Case]:
    """Yield some 40 questions: all methods on functions and in traffic."""
    for name, (dim, f) in FUNCTIONS.items():
        for method in METHODS if name in ("plane", "two modes") else ("auto", "two-stage", "ice", "adss"):
            ask = partial(ask_estimates, partial(samplers.FunctionProblem, f, dim), method=method, max_sim=4000)
            ask = partial(ask, max_sim=400) if method == "surrogate" else ask
            yield Case("estimates of functions", f"{name} {method}", ask, "estimate")
    for env_id in SCRIPTS:
        make = partial(rare_envs.DrivingProblem, env_id, core="torch", base="us101")
        for method in METHODS if env_id == CUT_IN else ("auto", "ce", "adss"):
            gamma, n = (0.5 if method == "mc" else 0.0), (400 if method == "surrogate" else 4000)
            ask = partial(ask_estimates, make, method=method, gamma=gamma, max_sim=n, ensemble_run=False)
            yield Case("estimates in traffic", f"{env_id} {method}", ask, "estimate")
    make = partial(rare_envs.DrivingProblem, HIGHWAY, core="torch", drivers=newest_mgail())
    ask = partial(ask_estimates, make, method="adss", gamma=1.5, max_sim=600)
    yield Case("estimates in traffic", "highway adss", ask, "estimate")
    ego = str(record.folder / "ppo.zip")
    make = partial(lambda: rare_envs.DrivingProblem(CUT_IN, ego=agents.load_ego(ego), core="torch"))
    yield Case("estimates in traffic", "ppo with refits", partial(ask_estimates, make, max_sim=4000), "estimate")


def flatten(observed: Any) -> np.ndarray:
    """Return an observation, or a `Dict` of them, as one row."""
    parts = [observed[name] for name in sorted(observed)] if isinstance(observed, dict) else [observed]
    return np.concatenate([np.asarray(part, float).ravel() for part in parts])


def ask_env(env_id: str, resets: int, **keywords: Any) -> Values:
    """Return x, observations, rewards and what `info` has, of some resets and five random steps each."""
    env = gym.make(env_id, **keywords)
    env.action_space.seed(0)
    seen, x, numbers = [], [], []
    for seed in range(resets):
        observed, info = env.reset(seed=seed)
        seen.append(flatten(observed))
        x.append(info["x"])
        for _ in range(5):
            observed, reward, ended, cut, info = env.step(env.action_space.sample())
            seen.append(flatten(observed))
            numbers.append([reward, ended, cut, info["min_ttc"], info["collision"], info.get("measure", -9.0)])
            if ended or cut:
                break
    env.close()
    return {"seen": np.array(seen), "x": np.array(x, float), "numbers": np.array(numbers, float)}


def ask_batch(env_id: str) -> Values:
    """Return observations and rewards of 64 scenarios side by side for 150 steps, with their restarts."""
    batch = gym.make_vec(env_id, num_envs=64, vectorization_mode="vector_entry_point")
    seen, rewards = [batch.reset(seed=0)[0]], []
    rng = np.random.default_rng(0)
    for _ in range(150):
        observed, reward, *_ = batch.step(rng.uniform(-0.3, 0.3, (64, 2)).astype(np.float32))
        seen.append(observed)
        rewards.append(reward)
    return {"seen": np.array(seen), "rewards": np.array(rewards)}


def ask_parallel(env_id: str) -> Values:
    """Return observations of all agents for 20 resets of ten steps."""
    env = rare_envs.parallel_env(env_id)
    seen = []
    for seed in range(20):
        observed, _ = env.reset(seed=seed)
        for _ in range(10):
            seen.append(np.concatenate([flatten(observed[agent]) for agent in observed]))
            observed, _, ended, _, _ = env.step({agent: np.array([0.1, 0.0], np.float32) for agent in env.agents})
            if any(ended.values()):
                break
    return {"seen": np.concatenate(seen)}


def cases_of_observations(record: Record) -> Iterator[Case]:
    """Yield environments by id, observation and action; batches; all vehicles as agents."""
    del record
    for env_id in (*SCRIPTS, HIGHWAY):
        for observation in ("features", "lidar", "kinematics", "speed", "camera"):
            for action in ("continuous", "discrete", "meta"):
                if observation == "camera" and action != "continuous":
                    continue
                resets = 5 if observation == "camera" else 100 if action == "continuous" and env_id != HIGHWAY else 20
                more = {"drivers": newest_mgail()} if env_id == HIGHWAY else {}
                ask = partial(ask_env, env_id, resets, observation=observation, action=action, **more)
                yield Case("observations", f"{env_id} {observation} {action}", ask)
        yield Case("observations", f"{env_id} lidar+speed", partial(ask_env, env_id, 10, observation="speed+lidar"))
    for env_id in SCRIPTS:
        yield Case("observations", f"{env_id} batch", partial(ask_batch, env_id))
        yield Case("observations", f"{env_id} agents", partial(ask_parallel, env_id))


COMMANDS = """
list; list egos; list bases; list CutIn-v0; list --json; list cut_in; list cut_in --json; list nothing; --version
bogus; list --bogus; estimate; estimate rare_envs/CutInn-v0; estimate rare_envs/CutIn-v0 --ego nobody
estimate rare_envs/CutIn-v0 --ego missing.zip; estimate rare_envs/CutIn-v0 --method best
estimate rare_envs/CutIn-v0 --measure tcc; estimate rare_envs/CutIn-v0 --base us102
estimate rare_envs/CutIn-v0 --max-sim 0; estimate rare_envs/CutIn-v0 --max-sim many
estimate rare_envs/CutIn-v0 --gamma nan; estimate rare_envs/CutIn-v0 --seed -1
estimate rare_envs/CutIn-v0 --max-p 2; estimate x --config missing.yaml
estimate rare_envs/CutIn-v0 --target-cov 0; estimate CutIn-v0 --workers 0
estimate rare_envs/CutIn-v0 --max-sim 3000 --out run --json; estimate rare_envs/CutIn-v0 --max-sim 3000 --out run
estimate rare_envs/CutIn-v0 --max-sim 200 --method mc --out small --json
estimate rare_envs/CutIn-v0 --max-sim 3000 --max-p 0.5; estimate rare_envs/CutIn-v0 --max-sim 3000 --max-p 1e-9
estimate rare_envs/CutIn-v0 --max-sim 200 --method mc --max-p 1e-4 --json
estimate rare_envs/CutIn-v0 --max-sim 3000 --ego {ppo} --details
estimate rare_envs/CutIn-v0 --config run.yaml --json; estimate rare_envs/CutIn-v0 --config wrong.yaml
estimate rare_envs/CutIn-v0 --ego golden_ego:make_ego --method mc --gamma 1 --max-sim 400 --workers 2 --json
estimate rare_envs/CutIn-v0 --ego golden_ego:nothing; estimate rare_envs/CutIn-v0 --max-sim 500 --observation lidarr
estimate rare_envs/CarFollowing-v0 --max-sim 1000 --method adss --drivers gail --json
estimate highway-fast-v0 --max-sim 20 --method mc --json; estimate rare_envs/Highway-v0 --max-sim 100 --method mc --json
report run; report run --json; report nowhere; report run --figures bmp; replay run; replay run --failure 0 --json
replay run --failure 100000; replay run --all; replay run --out worst.png; replay nowhere; resume run; resume nowhere
export run --out crash.xosc; export run --out crash.xml --format commonroad; export run --out crash.txt
export run --out crash.xosc --format carla; export nowhere --out a.xosc; export run
corpus add run; corpus add nowhere
corpus run --ego idm; corpus run --ego imitation --junit corpus.xml; corpus run; corpus run --ego idm --corpus nowhere
compare idm {ppo} rare_envs/CutIn-v0 --max-sim 4000 --json; compare idm rare_envs/CutIn-v0; compare idm nobody CutIn-v0
compare idm {ppo} rare_envs/CutIn-v0 --max-sim 4000 --out compared; estimate CutIn-v0 --plan --target-cov 0.1
estimate CutIn-v0 --plan --target-cov 0; risk idm --max-sim 1000 --json; risk nobody; risk idm --sites us102
check-ego nobody CutIn-v0
check-ego {ppo} rare_envs/CutIn-v0; check-ego {ppo} rare_envs/CutIn-v0 --json --all; check-ego {ppo} CutIn-v9
check-ego {dqn} rare_envs/CutIn-v0 --observation lidar; check-ego idm rare_envs/CutIn-v0; check-ego {onnx} CutIn-v0
export {ppo} again.onnx; export missing.zip a.onnx; export {ppo}; fit --out bases; fit
fit --out bases --highd nowhere; fit --out bases --data nowhere; train-ego; train-ego rare_envs/CutIn-v0 --algo pppo
train-ego rare_envs/CutIn-v0 --steps 0 --out a.zip; train-ego rare_envs/CutIn-v0 --steps 512 --num-envs 16 --out a.zip
train-ego --from-failures nowhere
"""


def run_command(line: str) -> tuple[int, str, str]:
    """Run a command in this process; return its exit code, what it printed, and what it said on standard error."""
    out, err, words = io.StringIO(), io.StringIO(), sys.argv
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    sys.argv = ["rare-envs", *shlex.split(line)]
    code: Any = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            runpy.run_module("rare_envs", run_name="__main__")
    except SystemExit as end:
        code = end.code
    except Exception as error:
        code, _ = 1, err.write(f"TRACEBACK {type(error).__name__}: {error}")
    finally:
        sys.argv = words
        for number, handler in handlers.items():  # a command line that ends ignores them
            signal.signal(number, handler)
    return (code if isinstance(code, int) else 0), out.getvalue(), err.getvalue()


def ask_command(record: Record, folder: Path, line: str) -> Values:
    """Return exit code, last line of standard error, and the keys of a JSON answer, of a command run in a folder."""
    files = {"ppo": record.folder / "ppo.zip", "dqn": record.folder / "dqn.zip", "onnx": record.folder / "ppo.onnx"}
    os.chdir(folder)
    code, out, err = run_command(line.format(**files))
    said = (err.strip().splitlines() or [""])[-1].replace(str(record.folder), "DIR")
    keys = ",".join(sorted(json.loads(out))) if "--json" in line and code in (0, 3, 4, 5) else ""
    return {"code": np.array(code), "keys": np.array(keys), "said": np.array(said)}


def cases_of_commands(record: Record) -> Iterator[Case]:
    """Yield the commands, which run one after the other in one folder."""
    folder = Path(tempfile.mkdtemp())
    (folder / "run.yaml").write_text("env: rare_envs/CutIn-v0\nmethod: adss\nmax_sim: 2000\nseed: 1\n")
    (folder / "wrong.yaml").write_text("env: rare_envs/CutIn-v0\nmetod: adss\n")
    for line in (line.strip() for line in re.split(r"[;\n]", COMMANDS)):
        if line:
            yield Case("commands", line, partial(ask_command, record, folder, line), "command")


ALL_CASES = (
    cases_of_egos,
    cases_of_traffic,
    cases_of_measures,
    cases_of_bases,
    cases_of_observations,
    cases_of_estimates,
    cases_of_commands,
)


def ask(case: Case) -> Values:
    """Return what a case says; of an error, its text."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return case.ask()
        except Exception as error:
            return {"error": np.array(f"{type(error).__name__}: {error}")}


def judge(case: Case, old: Values, new: Values) -> str:
    """Return "same bits", "within tolerance: ..." or "DIFFERENT: ..."."""
    if "error" in old or "error" in new:
        same_kind = "error" in old and "error" in new
        texts = f"{old.get('error', 'no error')} | {new.get('error', 'no error')}"
        if same_kind:
            return "same bits" if str(old["error"]) == str(new["error"]) else f"within tolerance: {texts}"
        return f"DIFFERENT: {texts}"
    if case.rule == "command":
        return judge_command(old, new)
    if all(name in new and np.array_equal(old[name], new[name], equal_nan=True) for name in old):
        return "same bits"
    return judge_estimate(old, new) if case.rule == "estimate" else judge_arrays(old, new)


def judge_command(old: Values, new: Values) -> str:
    """Compare exit codes and keys of answers; other words of an error are only told."""
    codes, keys, said = ((old[name].item(), new[name].item()) for name in ("code", "keys", "said"))
    lost = set(keys[0].split(",")) - set(keys[1].split(","))
    if codes[0] != codes[1] or lost:
        return f"DIFFERENT: exit code {codes[0]} | {codes[1]}, keys lost {sorted(lost)}, {said[0]} | {said[1]}"
    return "same bits" if said[0] == said[1] else f"within tolerance: {said[0]} | {said[1]}"


def judge_estimate(old: Values, new: Values) -> str:
    """Compare p seed by seed with the joint standard error."""
    errors = np.hypot(old["p"] * old["cov"], new["p"] * new["cov"])
    gaps = np.abs(old["p"] - new["p"]) / np.where(errors > 0, errors, 1e-300)
    gaps = np.where(old["p"] == new["p"], 0.0, gaps)
    verdict = "within tolerance" if np.all(gaps <= 3) else "DIFFERENT"
    means = [f"{each['p'].mean():.3g} (c.o.v. {each['cov'].mean():.2g})" for each in (old, new)]
    return f"{verdict}: {' | '.join(means)}, {gaps.max():.1f} joint standard errors at most"


def judge_arrays(old: Values, new: Values) -> str:
    """Compare arrays by relative difference; tell how many rows differ by more."""
    verdict, notes = "within tolerance", []
    for name, before in old.items():
        after = new.get(name)
        if after is None or before.shape != after.shape:
            return f"DIFFERENT: {name} {before.shape} | {getattr(after, 'shape', 'missing')}"
        near = np.isclose(after, before, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True)
        bad = int((~near.reshape(len(near), -1).all(axis=1)).sum())
        verdict = "DIFFERENT" if bad else verdict
        worst = float(np.nanmax(np.abs(after - before), initial=0.0))
        if worst or bad:
            notes.append(f"{name}: {bad} of {len(before)} rows beyond 1e-5, largest difference {worst:.2g}")
    return f"{verdict}: {'; '.join(notes)}"


def prepare(record: Record) -> None:
    """Train two egos, export one, and write the module of another, where the folder has none."""
    record.folder.mkdir(parents=True, exist_ok=True)
    (record.folder / "golden_ego.py").write_text(EGO_MODULE)
    for algo, steps in (("ppo", 20_000), ("dqn", 4_000)):
        path = record.folder / f"{algo}.zip"
        if not path.exists():
            run_command(f"train-ego {CUT_IN} --algo {algo} --steps {steps} --num-envs 64 --out {path}")
    if not (record.folder / "ppo.onnx").exists():
        run_command(f"export {record.folder / 'ppo.zip'} {record.folder / 'ppo.onnx'}")


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=["record", "compare"])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", default="", help="cases whose group and name have this word")
    chosen = parser.parse_args()
    record = Record((chosen.out or chosen.folder).resolve(), chosen.action == "record")
    if record.writes:
        prepare(record)
    sys.path.insert(0, str(record.folder))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(record.folder), os.environ.get("PYTHONPATH", "")])
    print(f"code of {Path(rare_envs.__file__).parents[1]}", file=sys.stderr)
    return go_through(record, chosen.only)


def go_through(record: Record, only: str) -> int:
    """Ask all cases; keep what they say, or print the verdict of each group. Return 1 where one is DIFFERENT."""
    found = 0
    for cases_of in ALL_CASES:
        verdicts: dict[str, dict[str, str]] = {}
        start = time.process_time()
        for case in (case for case in cases_of(record) if only in f"{case.group} {case.name}"):
            path, answer = record.path(case.group, case.name), ask(case)
            if record.writes:
                np.savez(path, **answer)
                verdict = f"recorded {answer.get('error', '')}"
            elif path.exists():
                with np.load(path) as old:
                    verdict = judge(case, dict(old), answer)
            else:
                verdict = "DIFFERENT: not in the record"
            verdicts.setdefault(case.group, {})[case.name] = verdict
        for group, judged in verdicts.items():
            found |= print_group(group, judged)
        print(f"  {time.process_time() - start:.0f} CPU s", file=sys.stderr, flush=True)
    return found


def print_group(group: str, judged: dict[str, str]) -> int:
    """Print one line of a group, and one for each case that is not the same. Return 1 where one is DIFFERENT."""
    kinds = [verdict.partition(":")[0] for verdict in judged.values()]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    print(f"{group}: {counts}")
    for name, verdict in judged.items():
        if verdict not in ("same bits", "recorded "):
            print(f"    {name}: {verdict}")
    return int("DIFFERENT" in kinds)


if __name__ == "__main__":
    sys.exit(main())
