"""Coverage, gain and warnings of a method over repeated seeds, on the catalogue and on other sets of limit states.

    python -m benchmarks.estimators.two_stage.repeated_seeds --seeds 60 --set /path/of/problems.py \
        --json benchmarks/results/repeated_seeds.json

A set is a Python file with `make()`, which returns limit states by name: objects with `g`, `d` and `p`, or tuples
(f, d, p, ...); they fail where f <= 0 in N(0, I). Each run has a seed of its own, so that runs may be added later: with
`--runs` every run is written to a file of one line each, and those already there are not made again.
"""

import importlib.util
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from threadpoolctl import threadpool_limits

import samplers
from benchmarks.samplers.problems import PROBLEMS
from benchmarks.samplers.runs import about
from samplers.output import to_json_value
from samplers.problem import FloatArray, FunctionProblem

FAR_OFF = 4.0
"""A run is far off if its error is more than so many of its own standard errors; a normal one is once in 16,000."""
COLUMNS = ("problem", "dim", "p", "mean", "cov", "own_cov", "gain", "coverage", "low", "high", "upper_over_lower")


class NamedState(NamedTuple):
    """A limit state of a set."""

    name: str
    f: Callable[[FloatArray], FloatArray]
    dim: int
    p: float


@dataclass(frozen=True)
class SeededRun:
    """One run."""

    problem: str
    seed: int
    dim: int
    truth: float
    p: float
    low: float
    high: float
    cov: float
    n_sim: int
    status: str
    warnings: tuple[str, ...] = ()

    @property
    def covered(self) -> bool:
        """Whether the interval holds the true p."""
        return self.low <= self.truth <= self.high

    @property
    def error_over_own(self) -> float:
        """Error over the standard error that the run states; 0 where it states none, as of p = 0."""
        own = self.cov * self.p
        return (self.p - self.truth) / own if 0 < own < math.inf else 0.0

    @property
    def far_off(self) -> bool:
        """Whether the error is more than FAR_OFF own standard errors."""
        return not abs(self.p - self.truth) <= FAR_OFF * self.cov * self.p

    @property
    def doubted(self) -> bool:
        """Whether the run has a warning."""
        return bool(self.warnings)


@dataclass(frozen=True)
class Row:
    """All runs on one problem, or on several."""

    problem: str
    dim: int
    p: float
    runs: int
    mean: float
    """Of the estimates, over p."""
    cov: float
    """Root mean square relative error."""
    own_cov: float
    """Median of those stated."""
    error_over_own: float
    """Root mean square of the errors over the run's own standard errors: 1 where these are right."""
    gain: float
    """(1 - p) / p / (n_sim x mean square relative error)."""
    coverage: float
    low: int
    """Intervals wholly below p."""
    high: int
    """Intervals wholly above p."""
    upper_over_lower: float
    """Of the ends of the interval, the median."""
    far_off: int
    """Runs off by more than FAR_OFF own standard errors."""
    far_off_warned: int
    right_warned: float
    """Share of the other runs with a warning."""
    n_sim: float


def load_set(path: Path) -> Iterator[NamedState]:
    """Yield the limit states of a file."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None, path
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name, state in module.make().items():
        if isinstance(state, tuple):
            yield NamedState(name, state[0], state[1], state[2])
        else:
            yield NamedState(name, state.g, state.d, state.p)


def load_catalogue() -> Iterator[NamedState]:
    """Yield the problems of the benchmark's catalogue."""
    for name, case in PROBLEMS.items():
        if case.group in ("public", "driving"):
            continue
        state = case.make()
        problem = state.problem(case.rotation, noise_seed=0)
        yield NamedState(name, problem.evaluate, state.dim, state.p)


def run_seed(state: NamedState, method: str, seed: int, max_sim: int) -> SeededRun:
    """Run a method once on a limit state."""
    with threadpool_limits(limits=1):
        result = samplers.estimate(FunctionProblem(state.f, state.dim), method, seed=seed, max_sim=max_sim)
    low, high = result.interval
    return SeededRun(
        problem=state.name,
        seed=seed,
        dim=state.dim,
        truth=state.p,
        p=result.p,
        low=low,
        high=high,
        cov=result.cov,
        n_sim=result.n_sim,
        status=str(result.status),
        warnings=result.warnings,
    )


def summarise_runs(name: str, runs: Sequence[SeededRun]) -> Row:
    """Return what the runs on one problem, or several, come to; sums over problems have no p and no gain."""
    one = len({run.problem for run in runs}) == 1
    ratio = np.array([run.p / run.truth for run in runs])
    square = float(((ratio - 1) ** 2).mean())
    n_sim, p = float(np.mean([run.n_sim for run in runs])), runs[0].truth
    right = [run for run in runs if not run.far_off]
    spread = [run.high / run.low if run.low > 0 else math.inf for run in runs]
    return Row(
        problem=name,
        dim=runs[0].dim if one else 0,
        p=p if one else math.nan,
        runs=len(runs),
        mean=float(ratio.mean()),
        cov=math.sqrt(square),
        own_cov=float(np.median([run.cov for run in runs])),
        error_over_own=math.sqrt(np.mean([run.error_over_own**2 for run in runs])),
        gain=(1 - p) / p / (n_sim * square) if one and square > 0 else math.nan,
        coverage=float(np.mean([run.covered for run in runs])),
        low=sum(run.high < run.truth for run in runs),
        high=sum(run.low > run.truth for run in runs),
        upper_over_lower=float(np.median(spread)),
        far_off=len(runs) - len(right),
        far_off_warned=sum(run.far_off and run.doubted for run in runs),
        right_warned=float(np.mean([run.doubted for run in right])) if right else math.nan,
        n_sim=n_sim,
    )


def describe_row(row: Row) -> str:
    """Return a row of the table."""
    return (
        f"| {row.problem} | {row.dim} | {row.p:.2e} | {row.mean:.3f} | {row.cov:.3f} ({row.own_cov:.3f}) | "
        f"{row.error_over_own:.2f} | {row.gain:.3g} | {row.coverage:.1%} | {row.low} : {row.high} | "
        f"{row.upper_over_lower:.2f} | {row.far_off}, {row.far_off_warned} | {row.right_warned:.0%} | "
        f"{row.n_sim:,.0f} |"
    )


NAMES = "problem, d, p, mean, c.o.v. (own), error / own, gain, coverage, low : high, U/L, off warned, right, n".split(
    ", "
)
HEADER = f"| {' | '.join(NAMES)} |\n|{'---|' * len(NAMES)}"


def read_runs(path: Path | None) -> list[SeededRun]:
    """Return the runs of a file, none if there is no such file."""
    if path is None or not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    return [SeededRun(**{**row, "warnings": tuple(row["warnings"])}) for row in map(json.loads, lines)]


def main(
    seeds: Annotated[int, typer.Option(help="Runs of each problem.")] = 60,
    first_seed: Annotated[int, typer.Option(help="Seed of the first of them.")] = 0,
    sets: Annotated[
        list[Path] | None, typer.Option("--set", help="Files of limit states; none: the catalogue.")
    ] = None,
    problems: Annotated[str, typer.Option(help="Names, with commas; none: all.")] = "",
    method: Annotated[str, typer.Option(help="Name of the method.")] = "two-stage",
    max_sim: Annotated[int, typer.Option(help="Simulations of a run.")] = 6000,
    runs: Annotated[Path | None, typer.Option(help="File of all runs, one line each.")] = None,
    json_path: Annotated[Path | None, typer.Option("--json", help="File of the table.")] = None,
) -> None:
    """Run a method with many seeds and print coverage, gain and warnings."""
    wanted = set(problems.split(",")) - {""}
    every = [one for path in sets for one in load_set(path)] if sets else list(load_catalogue())
    states = [state for state in every if not wanted or state.name in wanted]
    done = {(run.problem, run.seed): run for run in read_runs(runs)}
    rows, pooled = list[Row](), list[SeededRun]()
    print(HEADER)
    for state in states:
        mine = []
        for seed in range(first_seed, first_seed + seeds):
            if (state.name, seed) not in done:
                done[state.name, seed] = run_seed(state, method, seed, max_sim)
                if runs is not None:
                    with runs.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(asdict(done[state.name, seed])) + "\n")
            mine.append(done[state.name, seed])
        rows.append(summarise_runs(state.name, mine))
        pooled += mine
        print(describe_row(rows[-1]), flush=True)
    rows.append(summarise_runs("all", pooled))
    print(describe_row(rows[-1]))
    if json_path is not None:
        names = [Path(word).name if word.endswith((".py", ".jsonl")) else word for word in sys.argv[1:]]
        command = " ".join(["python -m benchmarks.estimators.two_stage.repeated_seeds", *names])
        content = {
            "about": about(command=command, method=method, max_sim=max_sim),
            "rows": [asdict(row) for row in rows],
        }
        json_path.write_text(json.dumps(to_json_value(content), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
