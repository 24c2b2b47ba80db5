"""Do the methods agree on sums over strata of traffic? By stratum, beside plain Monte Carlo.

    python -m benchmarks.estimators.roads --ego idm,human,runs/demo/ego.zip

asks two-stage, adaptive subset simulation, plain Monte Carlo and the default about each ego in `CutIn-v1` and
`HardBrake-v0`, and draws every stratum by itself without a sampler. benchmarks/results/roads.json has p, interval and
gain of each run and stratum, and which intervals do not meet that of the plain draws. Cells that are asked for again
are replaced, all others stay. What too few simulations give in a stratum with many failure regions:

    python -m benchmarks.estimators.roads --ego idm --env CutIn --method two-stage,auto --max-sim 8000 --seeds 5
"""

import json
import sys
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

import rare_envs
import samplers
from agents import load_ego
from benchmarks import RESULTS
from rare_envs.startup import use_one_thread
from samplers.problem import read_strata
from samplers.sample import clopper_pearson

ROADS_RESULT = RESULTS / "roads.json"
ENVS = ("rare_envs/CutIn-v1", "rare_envs/HardBrake-v0")
METHODS = ("mc", "two-stage", "adss", "auto")
PLAIN = "plain draws"
"""Name of the rows without a sampler."""
CHUNK = 50_000
USUAL_BUDGET = 20_000
"""Simulations of a run; rows of runs with others have them in the name of the method."""


class StratumRow(NamedTuple):
    """One stratum by one method and seed."""

    env_id: str
    ego: str
    stratum: str
    method: str
    seed: int
    p: float
    low: float
    """Ends of the 95 % interval."""
    high: float
    n_sim: int
    gain: float | None
    """(1 - p) / p / (n_sim x c.o.v.^2): plain simulations for the same c.o.v. over those made; None if not resolved."""
    resolved: bool
    """Whether p is known; else the upper end alone is, as `samplers.Part` says."""
    by: str
    """Methods of its runs."""
    doubts: int
    """Warnings and remarks that name the stratum."""


def make_problem(env_id: str, ego: str) -> rare_envs.DrivingProblem:
    """Return an ego, a name or a file, in a scenario with its default base distribution."""
    return rare_envs.DrivingProblem(env_id, load_ego(ego) if ego.endswith(".zip") else ego)


def draw_plain(problem: rare_envs.DrivingProblem, ego: str, draws: int, seed: int) -> Iterator[StratumRow]:
    """Yield p of each stratum from plain draws of its base distribution; their seed is no run's."""
    for number, stratum in enumerate(read_strata(problem.base)):
        rng, hits = np.random.default_rng([2026, seed, number]), 0
        for first in range(0, draws, CHUNK):
            hits += int((problem.evaluate(stratum.base.sample(min(CHUNK, draws - first), rng)) <= 0.0).sum())
        ends = clopper_pearson(hits, draws, 0.95)
        gain, cells = 1.0 if hits else None, (seed, hits / draws, *ends, draws)
        yield StratumRow(problem.env_id, ego, stratum.name, PLAIN, *cells, gain, hits > 0, "mc", 0)


def run_method(problem: rare_envs.DrivingProblem, ego: str, method: str, seed: int, most: int) -> Iterator[StratumRow]:
    """Yield the strata of one run."""
    found = samplers.estimate(problem, method, seed=seed, max_sim=most, ensemble_run=False)
    for part in found.parts:
        gain = (1.0 - part.p) / part.p / (part.n_sim * part.cov**2) if part.resolved else None
        doubts = sum(each.startswith(part.name) for each in (*found.warnings, *found.remarks))
        name = method if most == USUAL_BUDGET else f"{method}, max_sim {most}"
        cells = part.p, *part.interval, part.n_sim, gain, part.resolved, part.method, doubts
        yield StratumRow(problem.env_id, ego, part.name, name, seed, *cells)


def find_disagreements(rows: list[StratumRow]) -> list[str]:
    """Return which runs have intervals wholly above or below that of the plain draws of their stratum."""
    plain = {(row.env_id, row.ego, row.stratum): row for row in rows if row.method == PLAIN}
    found = []
    for row in rows:
        of = plain.get((row.env_id, row.ego, row.stratum))
        if of is not None and (row.low > of.high or row.high < of.low):
            where = f"{row.env_id}, {row.ego}, {row.stratum}: {row.method}, seed {row.seed}"
            found.append(f"{where}: {row.low:.2e} to {row.high:.2e}, plain draws {of.low:.2e} to {of.high:.2e}")
    return found


def write(rows: list[StratumRow], command: str) -> None:
    """Write rows, disagreements and the commands that all rows are of; rows of other cells stay."""
    old = json.loads(ROADS_RESULT.read_text()) if ROADS_RESULT.exists() else {"commands": [], "rows": []}
    cells, commands = old["rows"], sorted({*old["commands"], command})
    kept = {row[:5]: row for row in (*(StratumRow(**cell) for cell in cells), *rows)}
    rows = sorted(kept.values())
    versions = {"rare_envs": rare_envs.__version__, "numpy": np.__version__}
    about: dict[str, Any] = {"commands": commands, "versions": versions, "disagreements": find_disagreements(rows)}
    lines = ",\n".join(f"  {json.dumps(row._asdict())}" for row in rows)
    head = json.dumps(about, indent=1).removesuffix("\n}")
    ROADS_RESULT.write_text(f'{head},\n "rows": [\n{lines}\n ]\n}}\n')


@use_one_thread()
def main(
    ego: Annotated[str, typer.Option(help="Names or files, with commas between.")] = "idm,human",
    env: Annotated[str, typer.Option(help="Only environments whose id contains this.")] = "",
    method: Annotated[str, typer.Option(help="With commas between.")] = ",".join(METHODS),
    seeds: int = 3,
    max_sim: Annotated[int, typer.Option(help="Simulations of a run.")] = USUAL_BUDGET,
    draws: Annotated[int, typer.Option(help="Plain draws of each stratum; 0 keeps those that were made.")] = 1_000_000,
    slow_draws: Annotated[int, typer.Option(help="The same where rollouts are not compiled.")] = 200_000,
) -> None:
    """Ask every method, print what came out, and write it."""
    command = f"python -m benchmarks.estimators.roads {' '.join(sys.argv[1:])}".strip()
    for name in ego.split(","):
        for env_id in (each for each in ENVS if env in each):
            problem = make_problem(env_id, name)
            most = draws if problem.core == "numba" else min(draws, slow_draws)
            jobs = [draw_plain(problem, name, most, 0)] if draws else []
            asked = method.split(",") if method else ()
            jobs += [run_method(problem, name, each, seed, max_sim) for each in asked for seed in range(seeds)]
            for job in jobs:
                rows = list(job)
                for row in rows:
                    gain = "" if row.gain is None else f"{row.gain:.3g}"
                    ends = f"{row.p:.2e} {row.low:.2e} {row.high:.2e}"
                    print(*row[:5], ends, row.n_sim, gain, *row[10:], flush=True)
                write(rows, command)


if __name__ == "__main__":
    typer.run(main)
