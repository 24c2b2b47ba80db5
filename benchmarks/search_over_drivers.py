"""Can a search find how drivers make an ego crash, and does it pay? Highway-v0 with learned drivers.

    python -m benchmarks.search_over_drivers --ego idm --noise fixed --gamma 0.47 --json search.json

P[lidar_ttc <= gamma] by several methods, each with `--runs` seeds, beside a long Monte Carlo reference. Every
simulation counts, those of the search too; the gain is that over Monte Carlo at equal error. Then what the failures
look like: the law of the scenario parameters given f <= gamma from the weighted draws of the cross-entropy search
(O'Kelly et al. 2018, section 4: vehicles box in the ego, those behind are 20 % faster, variances are half), and what
the drivers' weights among them do to hard brakes and lane changes.
"""

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

import agents
import rare_envs
import samplers
from benchmarks.runs import about
from rare_envs.rollout import drive
from samplers.problem import FloatArray
from samplers.result import plain

METHODS: dict[str, Any] = {
    "ce": samplers.CrossEntropy(family="blocks", rho=0.1, alpha=0.8, n_iteration=500, max_iterations=6, n_final=3000),
    "ce-paper-vision": samplers.CrossEntropy(
        family="blocks", rho=0.01, alpha=0.8, n_iteration=1000, max_iterations=20, n_final=20_000
    ),
    "adss": samplers.AdaptiveSubsetSimulation(),
    "two-stage": samplers.TwoStage(),
}


@dataclass(frozen=True)
class Row:
    """Some runs of a method."""

    method: str
    runs: int
    mean_over_p: float
    cov: float
    """Spread of the estimates / their mean."""
    own_cov: float
    gain: float
    """p (1 - p) / (n_sim x mean square error)."""
    coverage: float
    warned: float
    n_sim: float
    seconds: float


def reference(problem: rare_envs.DrivingProblem, gamma: float, n: int, seed: int) -> dict[str, Any]:
    """Long plain Monte Carlo, in pieces that fit into memory."""
    rng, hits = np.random.default_rng(seed), 0
    for size in pieces(n, 8192):
        f = problem.evaluate(problem.base.sample(size, rng))
        hits += int((f <= gamma).sum())
    p = hits / n
    return {"p": p, "standard_error": float(np.sqrt(p * (1 - p) / n)), "rollouts": n, "seed": seed}


def pieces(n: int, size: int) -> Iterator[int]:
    """Sizes of pieces that add up to n."""
    while n > 0:
        yield min(n, size)
        n -= size


def compare(name: str, problem: rare_envs.DrivingProblem, gamma: float, p: float, runs: int, max_sim: int) -> Row:
    """Run a method with several seeds."""
    start = time.process_time()
    limit = None if name == "ce-paper-vision" else max_sim
    found = [samplers.estimate(problem, METHODS[name], gamma=gamma, seed=s, max_sim=limit) for s in range(runs)]
    ratio = np.array([each.p for each in found]) / p
    n_sim = float(np.mean([each.n_sim for each in found]))
    return Row(
        method=name,
        runs=runs,
        mean_over_p=float(ratio.mean()),
        cov=float(ratio.std(ddof=1) / ratio.mean()) if runs > 1 else float("nan"),
        own_cov=float(np.mean([each.cov for each in found])),
        gain=(1 - p) / p / (n_sim * float(np.mean((ratio - 1) ** 2))),
        coverage=float(np.mean([each.interval[0] <= p <= each.interval[1] for each in found])),
        warned=float(np.mean([bool(each.warnings) for each in found])),
        n_sim=n_sim,
        seconds=(time.process_time() - start) / runs,
    )


def failures(problem: rare_envs.DrivingProblem, result: samplers.Estimate, rng: np.random.Generator) -> dict[str, Any]:
    """The law of the scenario parameters given failure, against the base law.

    Speeds of the vehicles that start behind the ego and ahead of it, their distance from it along the road, and the
    variance of every parameter, each as ratio or difference between failures and base.
    """
    assert result.sample is not None
    weights = result.sample.weights[result.sample.f <= result.gamma]
    weights = weights / weights.sum()
    base = problem.base.sample(20_000, rng)
    out: dict[str, Any] = {"effective_failures": float(1 / np.sum(weights**2))}
    failing, usual = (problem.space.columns(x) for x in (result.sample.x, base))
    even = np.full(len(base), 1 / len(base))
    for name in ("s", "t", "heading", "speed"):
        ratio = spread(failing[name][:, 1:], weights) / spread(usual[name][:, 1:], even)
        out[f"variance_ratio_{name}"] = float(ratio.mean())
    for kind, columns, w in (("failures", failing, weights), ("base", usual, even)):
        behind = columns["s"][:, 1:] < columns["s"][:, :1]
        speed, gap = columns["speed"][:, 1:], np.abs(columns["s"][:, 1:] - columns["s"][:, :1])
        out[f"speed_behind_{kind}"] = average(speed, behind, w)
        out[f"speed_ahead_{kind}"] = average(speed, ~behind, w)
        out[f"distance_next_lanes_{kind}"] = float(w @ gap[:, [1, 2]].mean(axis=1))
        out[f"ego_speed_{kind}"] = float(w @ columns["speed"][:, 0])
    shift = weights @ failing["weights"] - usual["weights"].mean(axis=0)
    out["largest_shift_of_a_weight"] = float(np.abs(shift).max())
    return out


def spread(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted variance of each column."""
    mean = weights @ values
    return np.asarray(weights @ (values - mean) ** 2)


def average(values: FloatArray, chosen: Any, weights: FloatArray) -> float:
    """Weighted mean of the chosen entries of (n, k)."""
    w = weights[:, None] * chosen
    return float((w * values).sum() / w.sum())


def behaviour(problem: rare_envs.DrivingProblem, x: FloatArray) -> dict[str, float]:
    """What the five drivers do: shares of vehicle-steps with hard brakes, lane changes per vehicle and 10 s, speed."""
    hard, changes, speeds, lanes, before = [], [], [], None, None
    road = problem.world.scenario.road
    with torch.inference_mode():
        for episode in drive(problem.world, problem.driver, torch.from_numpy(x).float()):
            speed = episode.state.speed[:, 1:]
            lane = road.lane_of(episode.state.y[:, 1:])
            if before is not None and lanes is not None:
                hard.append(((speed - before) / problem.world.dt <= -3.0).float().mean())
                changes.append((lane != lanes).float().mean())
            before, lanes = speed, lane
            speeds.append(speed.mean())
    return {
        "hard_brake": float(torch.stack(hard).mean()),
        "lane_changes": float(torch.stack(changes).sum()) * 10.0 / problem.world.seconds,
        "speed": float(torch.stack(speeds).mean()),
    }


def main(
    ego: Annotated[str, typer.Option(help="idm, or mgail: a learned driver with lidar.")] = "idm",
    drivers: Annotated[str, typer.Option(help="Of the five others.")] = "mgail",
    noise: Annotated[str, typer.Option(help="fixed: 428 dimensions; on: 1,448.")] = "fixed",
    gamma: Annotated[float, typer.Option(help="Threshold of lidar_ttc [s].")] = 0.47,
    rollouts: Annotated[int, typer.Option(help="Of the Monte Carlo reference.")] = 200_000,
    runs: Annotated[int, typer.Option(help="Seeds of each method.")] = 10,
    max_sim: Annotated[int, typer.Option(help="Simulations of a run; all of the search count.")] = 6000,
    methods: Annotated[str, typer.Option(help="Names with commas between.")] = "ce,adss,two-stage",
    seed: int = 1,
    out: Annotated[Path | None, typer.Option("--json")] = None,
) -> None:
    """Measure, print and, if asked for, write."""
    torch.set_num_threads(1)
    who: Any = "idm" if ego == "idm" else agents.LearnedEgo(agents.load_driver(ego))  # type: ignore[arg-type]
    problem = rare_envs.DrivingProblem(
        "rare_envs/Highway-v0",
        ego=who,
        measure="lidar_ttc",
        noise={"on": True, "fixed": "fixed", "off": False}[noise],
        drivers=drivers,
    )
    truth = reference(problem, gamma, rollouts, seed)
    print(f"{problem.dim} dimensions, p = {truth['p']:.3g} +- {truth['standard_error']:.1g} ({rollouts:,} rollouts)")
    rows = []
    for name in methods.split(","):
        rows.append(compare(name, problem, gamma, truth["p"], runs, max_sim))
        print(rows[-1], flush=True)
    rng = np.random.default_rng(seed)
    search = samplers.estimate(problem, METHODS["ce"], gamma=gamma, seed=seed, max_sim=4 * max_sim)
    law = failures(problem, search, rng)
    base = problem.base.sample(2000, rng)
    searched = base.copy()
    at = slice(24, 24 + 404)
    assert search.sample is not None
    weights = search.sample.weights[search.sample.f <= gamma]
    searched[:, at] = search.sample.x[rng.choice(len(weights), 2000, p=weights / weights.sum())][:, at]
    acts = {"base": behaviour(problem, base), "weights of failures": behaviour(problem, searched)}
    print(json.dumps({"failures": law, "behaviour": acts}, indent=1))
    if out is not None:
        command = f"python -m benchmarks.search_over_drivers {' '.join(sys.argv[1:])}"
        data = {"about": about(command=command), "reference": truth, "rows": [asdict(row) for row in rows]}
        out.write_text(json.dumps(plain({**data, "failures": law, "behaviour": acts}), indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
