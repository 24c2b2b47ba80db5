"""How often does each ego crash in each scenario, by two methods, and what is its likeliest crash?

    python -m benchmarks.driving.egos

trains a PPO and a DQN ego in each scenario as the demo does, unless they are there already, asks `TwoStage` and
`AdaptiveSubsetSimulation` about every ego in every scenario, and writes docs/shipped_egos.md with its pictures and
benchmarks/results/egos.json. What that file has is not simulated again, but for the egos that are named: `--only
vision,ppo`. The rows of `vision`, whose pictures take time, come by

    python -m benchmarks.driving.egos --only vision --methods two-stage --env HardBrake-v0 --at-most 600
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
import typer

import rare_envs
from benchmarks import RESULTS
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.study import Question, Report, drive_again, prepare, run, write_film
from rare_envs.threads import use_one_thread
from training import train_ego

EGOS_RESULT = RESULTS / "egos.json"
STEPS = 400_000
"""Of the training of an ego, as in the demo."""
TRAINED = ("ppo", "dqn")
"""Egos that are trained here."""
PAGE_EGOS = ("idm", "imitation", "vision", "noisy:idm", "ppo", "dqn")
PAGE_METHODS = ("two-stage", "adss")
PAGE_BASES = {"rare_envs/CarFollowing-v0": "us101-gap"}
"""Base distributions in place of the default, where collisions are too rare under that to compare egos."""
MOST = {"vision": 1500}
"""Simulations of one run at most; the others get what the methods take by themselves."""
NARROW = 400
"""Width of the pictures [pixels]."""
HEAD = """# The shipped egos, everywhere

How often every ego that comes with this project collides within {horizon:g} s, in every scenario with its default
drivers and the base distribution named with it. Two more egos were trained in the scenario at hand by
`rare-envs train-ego ENV --algo ppo --steps STEPS` (`dqn` likewise; the steps stand in the row). A row has
the probability with its 95 % interval, by [two methods](estimates.md), simulations, wall time, number of warnings, and
the likeliest failure that `two-stage` found (`python -m benchmarks.driving.egos`). The
intervals are those of sampling; the events behind a base distribution leave p open by far more
([the events behind it](base_uncertainty.md#the-events-behind-the-base-distribution)). The bases are the defaults but
for car-following: under its default, `us101`, `idm` has 7.4e-11 and in 6,000 simulations of `imitation` nothing fails;
`us101-gap` is a test distribution under which egos and methods can be compared.

`vision` has {most:,} simulations at most, in `Highway-v0` 6,000 (26 minutes of a core), by the first method only since
its corrections ([camera](camera.md#the-ego-vision)). {missing}
Rows of 100,000 steps are of short trainings and do not compare with those of 400,000: `ppo` in `HardBrake-v0` still
crashes in a fifth of the brakings, where one of 400,000 steps crashed in 8e-05 under an earlier base of that scenario.
Wall times are from a busy machine of two cores, shared with more or less other work. In the older pictures crashed
vehicles are red; in the others they keep their colour and have a red outline. `dqn` chooses among five
accelerations and cannot steer: on the I-80's curves it leaves its lane, or the road. In the 1,448 dimensions of
`Highway-v0` no intermediate value of f predicts a collision, so all methods can do is count: intervals are wide
there, and warnings say so.

A row of it in Python, with half of the simulations:

```python
import rare_envs
import samplers

problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego="idm", base="us101-15-offsets")
print(samplers.estimate(problem, seed=0, max_sim=3000))
```

```text
P[f <= 0] = 7.4e-04
  95 % interval [6.7e-04, 8.6e-04], c.o.v. 0.053
  base distribution 95 %  1.2e-05 to 4.5e-02 (38 + 15 events of 17 scenes, 30 refits); predictive mean 5e-03
    assumes that the fitted family is correct (1 component, log gaps); errors of the family are not included
  3,000 simulations, gain over Monte Carlo 162; two-stage, seed 0, converged; 1,062 failing points
  valid if no failure region was missed; 332 base draws would have met one with probability above 9.0e-03 (95 %
  confidence)
```
"""


@dataclass(frozen=True)
class EgoResult:
    """One ego in one scenario, by one method."""

    env_id: str
    ego: str
    method: str
    p: float
    low: float
    high: float
    n_sim: int
    seconds: float
    """Wall time."""
    warnings: tuple[str, ...]
    picture: str = ""
    """File of the likeliest failure; empty without one, and for all methods but the first of `PAGE_METHODS`."""
    words: str = ""
    """What it is."""
    steps: int = 0
    """Environment steps of the ego's training; 0 for an ego that is not trained here."""


def version_of(env_id: str) -> str:
    """Return the name and version of an environment for the name of a file, such as "CutIn-v1"."""
    return env_id.rpartition("/")[2]


def train_cached(algo: str, env_id: str, steps: int, folder: Path) -> Path:
    """Return the ego of `rare-envs train-ego ENV --algo ALGO --steps STEPS`; one that was trained before is kept."""
    path = folder / f"{algo}_{version_of(env_id)}_{steps}.zip"
    return path if path.exists() else train_ego(env_id, algo, steps, seed=0, out=path, base=PAGE_BASES.get(env_id))


def evaluate_ego(
    env_id: str, ego: str, method: str, steps: int, runs: Path, images: Path, at_most: int | None = None
) -> EgoResult:
    """Estimate, and draw the likeliest failure that the first of `PAGE_METHODS` has found.

    Args:
        env_id: The scenario.
        ego: One of `PAGE_EGOS`.
        method: Name of the method.
        steps: Of the training, for an ego that is trained here.
        runs: Folder of the trained egos.
        images: Folder of the pictures.
        at_most: Simulations at most; None for those of `MOST`.

    Returns:
        What came out.
    """
    trained = ego in TRAINED
    spec = str(train_cached(ego, env_id, steps, runs)) if trained else ego
    base = PAGE_BASES.get(env_id)
    most = at_most or MOST.get(ego)
    question = Question(env_id=env_id, ego=spec, method=method, max_sim=most, base=base, ensemble_run=False)
    report = run(prepare(question), progress=True)
    estimate = report.estimate
    file = images / f"ego_{version_of(env_id)}_{ego.replace(':', '_')}.png"
    picture, words = draw_likeliest(report, file) if method == PAGE_METHODS[0] else ("", "")
    return EgoResult(
        env_id,
        ego,
        method,
        estimate.p,
        *estimate.interval,
        n_sim=estimate.n_sim,
        seconds=report.seconds,
        warnings=estimate.warnings,
        picture=picture,
        words=words,
        steps=steps if trained else 0,
    )


def draw_likeliest(report: Report, path: Path) -> tuple[str, str]:
    """Draw the likeliest failure that a run has found; its file and what it is."""
    found = report.estimate.failures
    if len(found) == 0:
        return "", "no failure found"
    drive = drive_again(report.study.problem, found[0].x)
    write_film(path, drive, width=NARROW)
    crash = drive.crash
    return path.name, "no crash" if crash is None else f"{crash['kind']}, {crash['closing_speed']:.1f} m/s"


def format_page(cells: Iterable[EgoResult]) -> str:
    """Return the page of all results."""
    cells = list(cells)
    horizon = max(scenario.horizon for scenario in SCENARIOS.values())
    parts = [HEAD.format(horizon=horizon, most=MOST["vision"], missing=list_missing(cells))]
    for env_id in SCENARIOS:
        own = [cell for cell in cells if cell.env_id == env_id]
        if not own:
            continue
        rows = [format_row(cell) for cell in own]
        pictures = [
            f"**{cell.ego}**: {cell.words}\n\n![{cell.ego}: {cell.words}](images/{cell.picture})"
            for cell in own
            if cell.picture
        ]
        head = (
            "| ego | training steps | method | p | 95 % interval | simulations | wall time | warnings |\n"
            "|---|---|---|---|---|---|---|---|\n"
        )
        parts.append(
            f"## {env_id}, `{PAGE_BASES.get(env_id, SCENARIOS[env_id].default_base)}`\n\n{head}"
            + "\n".join(rows)
            + "\n\n"
            + "\n\n".join(pictures)
            + "\n"
        )
    return "\n".join(parts)


def list_missing(cells: Iterable[EgoResult]) -> str:
    """Return a sentence that names the egos without a row, by scenario."""
    measured = {(cell.env_id, cell.ego) for cell in cells}
    missing = {env_id: [f"`{ego}`" for ego in PAGE_EGOS if (env_id, ego) not in measured] for env_id in SCENARIOS}
    told = [f"{', '.join(egos)} in `{version_of(env_id)}`" for env_id, egos in missing.items() if egos]
    return f"Not measured: {'; '.join(told)}." if told else "Each ego was measured in each scenario."


def format_row(cell: EgoResult) -> str:
    """Return a row of the table."""
    steps = f"{cell.steps:,}" if cell.steps else ""
    return (
        f"| `{cell.ego}` | {steps} | `{cell.method}` | {cell.p:.2e} | {cell.low:.2e} to {cell.high:.2e} "
        f"| {cell.n_sim:,} | {cell.seconds:.0f} s | {len(cell.warnings) or ''} |"
    )


def read_results() -> dict[tuple[str, str, str], EgoResult]:
    """Return what has been measured so far, by scenario, ego and method."""
    cells = json.loads(EGOS_RESULT.read_text())["cells"] if EGOS_RESULT.exists() else []
    found = [EgoResult(**{**cell, "warnings": tuple(cell["warnings"])}) for cell in cells]
    return {(cell.env_id, cell.ego, cell.method): cell for cell in found}


def write_results(cells: dict[tuple[str, str, str], EgoResult]) -> None:
    """Write what has been measured."""
    versions = {"rare_envs": rare_envs.__version__, "torch": torch.__version__}
    about = {"command": "python -m benchmarks.driving.egos", "versions": versions}
    EGOS_RESULT.write_text(json.dumps({**about, "cells": [asdict(cell) for cell in cells.values()]}, indent=1) + "\n")


@use_one_thread()
def main(
    docs: Annotated[Path, typer.Option(help="Folder of the page.")] = Path("docs"),
    runs: Annotated[Path, typer.Option(help="Folder of the trained egos.")] = Path("runs/egos"),
    only: Annotated[str, typer.Option(help="Egos to measure anew, with commas between; all that are not yet.")] = "",
    env: Annotated[str, typer.Option(help="Only environments whose id contains this.")] = "",
    steps: Annotated[int, typer.Option(help="Of the training of an ego.")] = STEPS,
    methods: Annotated[str, typer.Option(help="With commas between.")] = ",".join(PAGE_METHODS),
    at_most: Annotated[int | None, typer.Option(min=1, help="Simulations of a run; usually what MOST has.")] = None,
) -> None:
    """Measure what is not measured yet and write the page."""
    chosen = only.split(",") if only else []
    measured = {key for key, cell in read_results().items() if cell.ego not in chosen or env not in cell.env_id}
    for key in [(env_id, ego, method) for env_id in SCENARIOS for ego in PAGE_EGOS for method in methods.split(",")]:
        if key in measured or env not in key[0] or (chosen and key[1] not in chosen):
            continue
        cell = evaluate_ego(*key, steps=steps, runs=runs, images=docs / "images", at_most=at_most)
        print(format_row(cell), flush=True)
        write_results({**read_results(), key: cell})  # read anew: another process may measure other egos
    order = {ego: place for place, ego in enumerate(PAGE_EGOS)}
    in_order = sorted(read_results().values(), key=lambda cell: (order[cell.ego], PAGE_METHODS.index(cell.method)))
    (docs / "shipped_egos.md").write_text(format_page(in_order), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
