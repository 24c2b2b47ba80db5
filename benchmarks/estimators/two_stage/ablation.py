"""What each component of two-stage buys: runs without it against runs with it.

    python -m benchmarks.estimators.two_stage.ablation --set problems_third.py --set problems_hard.py \
        --json benchmarks/results/two_stage_ablation.json

Each row leaves one component out (`ABLATIONS`), on the problems of the sets, at 6,000 simulations. The runs are paired
with runs of the default settings by their seeds. Ratios over 1 say that the component helps: of the variances that the
runs state, and of the mean squared errors, geometric means over the problems. What is stated knows nothing of a region
that is lost; the errors do, but those of few seeds are good to a factor of 1.3 over all problems and to 3 on one.
"""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from threadpoolctl import threadpool_limits

import samplers
from benchmarks.estimators.two_stage.repeated_seeds import NamedState, load_set
from benchmarks.estimators.two_stage.setting_sensitivity import VariedTwoStage
from benchmarks.samplers.runs import about
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, TwoStageSettings
from samplers.problem import FunctionProblem
from samplers.serialization import to_json_value

PROBLEMS = (
    "curved2_d15,sector_d6,banana_d8,parallel5_d12,series6_d25,loads_d7,drive_d6,rare9_d8,saddle_d10,screen_d40,"
    "crossing_d6,common3_d9,six_d8,two_d30,corner_d5,decep_d8,islands_d3,four_d100"
)
"""Of the sets `problems_third.py` and `problems_hard.py`: all mechanisms, without noise and without a fallback."""
HEADER = """| without | stated variance | largest | squared error | largest | coverage | low : high | simulations |
|---|---|---|---|---|---|---|---|"""


def _without_kinds(*kinds: str) -> dict[str, Any]:
    """Return the setting that leaves out kinds of components."""
    shares = DEFAULT_SETTINGS.refinement.initial_shares
    return {"refinement.initial_shares": {name: share for name, share in shares.items() if name not in kinds}}


ABLATIONS: dict[str, Mapping[str, Any]] = {
    "all half-spaces": _without_kinds("linear", "half-space", "corner"),
    "wide component": _without_kinds("wide"),
    "half-spaces through edges": _without_kinds("half-space"),
    "half-spaces of the regression": _without_kinds("linear"),
    "corners of the regression": _without_kinds("corner"),
    "radial components": _without_kinds("radial"),
    "directional component": _without_kinds("directional"),
    "slopes": {"slopes.min_dim": 10**9},
    "components of the exploration": _without_kinds("explored"),
    "tempered Gaussians": _without_kinds("tempered"),
    "further rounds": {"refinement.further_shares": ()},
    "lines of descent": {"lines.n": 1},
    "wide draws": {"exploration.wide": ((1.5, 2),), "exploration.deep_draws": 0},
    "subset simulation": {"exploration.descent_share": 0.0},
    "chains from uncovered failures": {"refinement.uncovered_budget": 0.0},
    "chains along a direction": {"regions.direction_r2": 1.1},
    "floors of the regions": {"refinement.region_share": 0.0, "refinement.final_region_share": 0.0},
    "Gaussians": _without_kinds("gaussian"),
    "wide draws as deep as the levels": {"exploration.deep_draws": 0},
    "placement by a regression": {"surfaces.min_gain": math.inf},
    "calibrated weights": {"draws_per_control": 10**9},
}
"""Settings without a component, by its name."""


@dataclass(frozen=True)
class AblationRun:
    """One run."""

    cov: float
    error: float
    """Estimate / p - 1."""
    low: bool
    """Whether its interval lies below p."""
    high: bool
    n_sim: int


@dataclass(frozen=True)
class AblationRow:
    """Runs without a component against runs with it."""

    without: str
    runs: int
    variance_ratio: float
    variance_ratio_se: float
    """Standard error of its logarithm."""
    variance_ratios: dict[str, float]
    """On each problem."""
    error_ratio: float
    error_ratios: dict[str, float]
    coverage: float
    low: int
    high: int
    n_sim: float


def replace_nested(settings: Any, path: str, value: object) -> Any:
    """Return settings with one of them replaced, by its path.

    Example:
        >>> replace_nested(DEFAULT_SETTINGS, "lines.n", 1).lines.n
        1
    """
    name, _, rest = path.partition(".")
    return replace(settings, **{name: replace_nested(getattr(settings, name), rest, value) if rest else value})


def run_state(state: NamedState, seed: int, settings: TwoStageSettings, max_sim: int) -> AblationRun:
    """Run two-stage once with some settings."""
    problem = FunctionProblem(state.f, state.dim)
    with threadpool_limits(limits=1):
        result = samplers.estimate(problem, VariedTwoStage(settings=settings), seed=seed, max_sim=max_sim)
    low, high = result.interval
    return AblationRun(result.cov, result.p / state.p - 1, high < state.p, low > state.p, result.n_sim)


def compare(name: str, problems: Sequence[str], varied: list[AblationRun], default: list[AblationRun]) -> AblationRow:
    """Return a row: runs of each problem in turn, the same number of seeds each."""
    shape = (len(problems), -1)
    cov = [np.array([min(run.cov, 10.0) for run in runs]) for runs in (varied, default)]
    logs = 2 * np.log(cov[0] / cov[1])
    squares = [np.square([run.error for run in runs]).reshape(shape).mean(axis=1) for runs in (varied, default)]
    stated, errors = np.exp(logs.reshape(shape).mean(axis=1)), squares[0] / squares[1]
    return AblationRow(
        without=name,
        runs=len(varied),
        variance_ratio=float(np.exp(logs.mean())),
        variance_ratio_se=float(logs.std()) / math.sqrt(len(logs)),
        variance_ratios=dict(zip(problems, stated.tolist(), strict=True)),
        error_ratio=float(np.exp(np.log(errors).mean())),
        error_ratios=dict(zip(problems, errors.tolist(), strict=True)),
        coverage=float(np.mean([not (run.low or run.high) for run in varied])),
        low=sum(run.low for run in varied),
        high=sum(run.high for run in varied),
        n_sim=float(np.mean([run.n_sim for run in varied])),
    )


def format_row(row: AblationRow) -> str:
    """Return a row as Markdown, in the columns of HEADER."""
    stated = f"{row.variance_ratio:.2f} ± {row.variance_ratio * row.variance_ratio_se:.2f}"
    largest, error = _largest(row.variance_ratios), _largest(row.error_ratios)
    return (
        f"| {row.without} | {stated} | {largest} | {row.error_ratio:.2f} | {error} | "
        f"{row.coverage:.1%} | {row.low} : {row.high} | {row.n_sim:,.0f} |"
    )


def _largest(ratios: Mapping[str, float]) -> str:
    """Return the largest ratio and its problem."""
    problem = max(ratios, key=lambda name: ratios[name])
    return f"{ratios[problem]:.3g} ({problem})"


def main(
    sets: Annotated[list[Path], typer.Option("--set", help="Files of limit states.")],
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each problem.")] = 8,
    problems: Annotated[str, typer.Option(help="Names, with commas.")] = PROBLEMS,
    only: Annotated[str, typer.Option(help="Components, with commas; none: all.")] = "",
    max_sim: Annotated[int, typer.Option(help="Simulations of a run.")] = 6000,
    out: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
) -> None:
    """Leave out one component after the other and print the table."""
    names = problems.split(",")
    found = {state.name: state for path in sets for state in load_set(path)}
    states = [found[name] for name in names]
    jobs = [(state, seed) for state in states for seed in range(seeds)]
    default = [run_state(*job, DEFAULT_SETTINGS, max_sim) for job in jobs]
    rows = [compare("nothing", names, default, default)]
    print(HEADER)
    print(format_row(rows[0]), flush=True)
    for name in only.split(",") if only else ABLATIONS:
        settings: Any = DEFAULT_SETTINGS
        for path, value in ABLATIONS[name].items():
            settings = replace_nested(settings, path, value)
        rows.append(compare(name, names, [run_state(*job, settings, max_sim) for job in jobs], default))
        print(format_row(rows[-1]), flush=True)
        if out:
            words = [Path(word).name if word.endswith("py") else word for word in sys.argv[1:]]
            command = " ".join(["python -m benchmarks.estimators.two_stage.ablation", *words])
            data = {"about": about(command=command, max_sim=max_sim), "rows": [asdict(row) for row in rows]}
            out.write_text(json.dumps(to_json_value(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
