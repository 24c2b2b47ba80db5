"""Command `bench samplers`: methods on problems with known probabilities."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rare_envs.plugins import working_directory_first
from rare_envs.study.cli.options import JsonOption
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import as_bad_input
from rare_envs.threads import use_one_thread

METHOD_HELP = (
    "Methods, with commas: names as in `estimate`, openturns-ss, -ce, -nais, -form, uqpy-ss, or module:attribute."
)

bench_app = typer.Typer(help="Measure methods on problems with known probabilities.")


@bench_app.callback()
def bench_command() -> None:
    """Measure methods on problems with known probabilities."""


@bench_app.command("samplers")
@use_one_thread()
def bench_samplers_command(
    method: Annotated[str, typer.Option(help=METHOD_HELP)] = "auto,mc,adss",
    groups: Annotated[str, typer.Option("--set", help="Sets: analytic, highdim, public, driving.")] = "analytic,public",
    problems: Annotated[str, typer.Option(help="Problems by name instead of sets.")] = "",
    budget: Annotated[str, typer.Option(help="Simulations of a run, with commas.")] = "300,1500,6000",
    runs: Annotated[int, typer.Option(min=2, help="Runs of each method on each problem.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first run.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder of the runs, figures and page; goes on with those there.")] = Path(
        "sampler_benchmark"
    ),
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Run methods many times on problems with known p; write bias, coverage, gain and faults of each."""
    from rare_envs.study.sampler_benchmark.study import BenchmarkPlan, choose_problems, run_study

    with (
        keep_stdout_for_the_answer(),
        as_bad_input(ValueError, ChildProcessError, ImportError),
        working_directory_first(),
    ):
        plan = BenchmarkPlan(
            methods=_split(method),
            problems=choose_problems(_split(groups), _split(problems)),
            budgets=tuple(_read_budget(each) for each in _split(budget)),
            runs=runs,
            seed=seed,
        )
        result = run_study(plan, out, workers, progress=True)
    if as_json:
        print_json({name: result[name] for name in ("about", "problems", "cells", "warnings")})
        return
    faulty = [cell for cell in result["cells"] if cell["faults"]]
    for cell in faulty:
        print(f"{cell['method']} on {cell['problem']}, {cell['max_sim']:,} simulations: {'; '.join(cell['faults'])}")
    print(f"{len(faulty)} of {len(result['cells'])} cells have faults. Wrote {out / 'leaderboard.md'}.")


def _read_budget(text: str) -> int:
    """Return a number of simulations, written as 6000 or 6e3.

    Raises:
        ValueError: It is no number.
    """
    try:
        return int(float(text))
    except (ValueError, OverflowError):
        raise ValueError(f"Expected --budget as numbers of simulations, such as 300,1500, got {text!r}.") from None


def _split(names: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in names.split(",") if name.strip())
