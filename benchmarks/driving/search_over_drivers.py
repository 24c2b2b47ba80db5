"""Can a search find how drivers make an ego crash, and does it pay? Highway-v0 with learned drivers.

    python -m benchmarks.driving.search_over_drivers --ego idm --noise fixed --gamma 0.56
    python -m benchmarks.driving.search_over_drivers --ego mgail --noise fixed --methods ce-paper --json paper.json

The first writes `benchmarks/results/search_idm_fixed.json`. The second has O'Kelly et al.'s settings: a learned ego
with lidar, 428 dimensions, 600,000 simulations.

P[lidar_ttc <= gamma] by several methods, each with `--runs` seeds, beside a long Monte Carlo reference. Every
simulation counts, those of the search too; the gain is that over Monte Carlo at equal error. Then what the failures
look like: the distribution of the scenario parameters given f <= gamma from the failing points of the last method's
runs (O'Kelly et al. 2018, section 4: vehicles box in the ego, those behind are 20 % faster, variances are half), and
the effect of the drivers' weights among them on hard brakes and lane changes.
"""

import json
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import agents
import rare_envs
import samplers
from benchmarks import RESULTS
from benchmarks.driving.failing_traffic import describe_failures, failing_points, measure_drivers
from rare_envs.threads import use_one_thread
from samplers.benchmark.runs import about
from samplers.serialization import to_json_value

PAPER = samplers.CrossEntropy(family="blocks", rho=0.01, alpha=0.8, early_end=False, choice="quantile", wide_share=0)
SEARCH_METHODS: dict[str, Any] = {
    # 50 elites for the means of 404 weights, as in the paper: noise of the means, not failures, is what it follows
    "ce-50-elites": samplers.CrossEntropy(
        family="blocks", rho=0.05, alpha=0.8, n_iteration=1000, max_iterations=10, n_final=3000
    ),
    "ce-1000-elites": samplers.CrossEntropy(
        family="blocks", rho=0.2, alpha=0.8, n_iteration=5000, max_iterations=5, n_final=10_000
    ),
    # O'Kelly et al., section 4: 600,000 simulations a run, 500,000 of them for the search
    "ce-paper": replace(PAPER, n_iteration=5000, max_iterations=100, n_final=100_000),
    "ce-paper-short": replace(PAPER, n_iteration=5000, max_iterations=20, n_final=20_000),
    # their search for the ego with a camera, with the joint ratio of the paper and the ratios by block of their code
    "ce-paper-20": replace(PAPER, n_iteration=1000, max_iterations=20, n_final=20_000),
    "ce-code-20": replace(PAPER, n_iteration=1000, max_iterations=20, n_final=20_000, likelihood_ratio="block"),
    "adss": samplers.AdaptiveSubsetSimulation(),
    "two-stage": samplers.TwoStage(),
}
OWN_BUDGET = tuple(name for name, method in SEARCH_METHODS.items() if isinstance(method, samplers.CrossEntropy))
"""Methods that spend what their settings say."""
NOISE_SETTINGS: dict[str, bool | str] = {"on": True, "fixed": "fixed", "off": False}
ONCE = ("ce-paper", "ce-paper-short")
"""Methods of which one run is made, whatever is asked for: a run takes 20 minutes of a core, or five."""


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
    p: list[float]
    """The estimate of each run."""
    intervals: list[tuple[float, float]]
    """The interval of each run."""


def check_word(word: str, words: Iterable[str]) -> str:
    """Return the word, if it is one of some; checked before hours of simulation."""
    if word not in words:
        raise typer.BadParameter(f"{word!r} is none of {', '.join(words)}.")
    return word


def run_reference(problem: rare_envs.DrivingProblem, gamma: float, n: int, seed: int) -> dict[str, Any]:
    """Return the result of long plain Monte Carlo, run in batches that fit into memory."""
    rng, hits = np.random.default_rng(seed), 0
    for size in split_sizes(n, 8192):
        f = problem.evaluate(problem.base.sample(size, rng))
        hits += int((f <= gamma).sum())
    p = hits / n
    return {"p": p, "standard_error": float(np.sqrt(p * (1 - p) / n)), "rollouts": n, "seed": seed}


def read_reference(path: Path, question: dict[str, Any]) -> dict[str, Any]:
    """Return the reference of an earlier report on the same question."""
    found = json.loads(path.read_text())
    if found.get("question") != question:
        raise typer.BadParameter(f"{path} answers {found.get('question')}, not {question}.")
    truth: dict[str, Any] = found["reference"]
    return truth


def split_sizes(n: int, size: int) -> Iterator[int]:
    """Yield sizes of batches that add up to n."""
    while n > 0:
        yield min(n, size)
        n -= size


def repeat_method(
    name: str, problem: rare_envs.DrivingProblem, gamma: float, p: float, runs: int, max_sim: int
) -> tuple[Row, list[samplers.Estimate]]:
    """Run a method with several seeds."""
    start = time.process_time()
    limit = None if name in OWN_BUDGET else max_sim
    found = [samplers.estimate(problem, SEARCH_METHODS[name], gamma=gamma, seed=s, max_sim=limit) for s in range(runs)]
    ratio = np.array([each.p for each in found]) / p
    n_sim = float(np.mean([each.n_sim for each in found]))
    row = Row(
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
        p=[each.p for each in found],
        intervals=[each.interval for each in found],
    )
    return row, found


@use_one_thread()
def main(
    ego: Annotated[str, typer.Option(help="idm, or mgail: a learned driver with lidar.")] = "idm",
    drivers: Annotated[str, typer.Option(help="Of the five others.")] = "mgail",
    noise: Annotated[str, typer.Option(help="fixed: 428 dimensions; on: 1,448.")] = "fixed",
    gamma: Annotated[float, typer.Option(help="Threshold of lidar_ttc [s].")] = 0.56,
    rollouts: Annotated[int, typer.Option(help="Of the Monte Carlo reference.")] = 200_000,
    runs: Annotated[int, typer.Option(help="Seeds of each method.")] = 10,
    max_sim: Annotated[int, typer.Option(help="Simulations of a run; all of the search count.")] = 6000,
    methods: Annotated[str, typer.Option(help="Names with commas between.")] = "ce-50-elites,two-stage,adss",
    seed: int = 1,
    truth_of: Annotated[Path | None, typer.Option("--reference", help="Report whose reference is taken.")] = None,
    out: Annotated[
        Path | None, typer.Option("--json", help="File for the result; search_EGO_NOISE.json without it.")
    ] = None,
) -> None:
    """Measure, print and write."""
    out = RESULTS / f"search_{ego}_{noise}.json" if out is None else out
    chosen = [check_word(name, SEARCH_METHODS) for name in methods.split(",")]
    how = NOISE_SETTINGS[check_word(noise, NOISE_SETTINGS)]
    who: Any = "idm" if ego == "idm" else agents.LearnedEgo(agents.load_driver(ego))  # type: ignore[arg-type]
    problem = rare_envs.DrivingProblem(
        "rare_envs/Highway-v0",
        ego=who,
        measure="lidar_ttc",
        noise=how,
        drivers=drivers,
    )
    question = {"ego": ego, "drivers": drivers, "noise": noise, "gamma": gamma}
    truth = read_reference(truth_of, question) if truth_of else run_reference(problem, gamma, rollouts, seed)
    error = f"{truth['standard_error']:.1g} ({truth['rollouts']:,} rollouts)"
    print(f"{problem.dim} dimensions, p = {truth['p']:.3g} +- {error}")
    command = f"python -m benchmarks.driving.search_over_drivers {' '.join(sys.argv[1:])}"
    data: dict[str, Any] = {"about": about(command=command), "question": question, "reference": truth, "rows": []}
    found: list[samplers.Estimate] = []
    for name in chosen:
        row, found = repeat_method(name, problem, gamma, truth["p"], 1 if name in ONCE else runs, max_sim)
        data["rows"].append(asdict(row))
        print(row, flush=True)
        write_result(out, data)  # a run at the paper's setting takes half an hour: nothing that was measured is lost
    rng = np.random.default_rng(seed)
    x, weights = failing_points(found)
    failing = describe_failures(problem, x, weights, rng)
    base = problem.base.sample(2000, rng)
    searched = base.copy()
    at = slice(24, 24 + 404)
    searched[:, at] = x[rng.choice(len(x), 2000, p=weights)][:, at]
    acts = {"base": measure_drivers(problem, base), "weights of failures": measure_drivers(problem, searched)}
    print(json.dumps({"failures": failing, "behaviour": acts}, indent=1))
    write_result(out, {**data, "failures": failing, "behaviour": acts})


def write_result(path: Path, data: dict[str, Any]) -> None:
    """Write what was measured."""
    path.write_text(json.dumps(to_json_value(data), indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
