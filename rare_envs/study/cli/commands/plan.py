"""Command `plan`: what an estimate of a wished precision costs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rare_envs.study.cli.options import AlgoOption, JsonOption, QuestionOptions, StatsOption
from rare_envs.study.cli.shell import is_typed, keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.threads import use_one_thread
from training.command_line import spread_options

if TYPE_CHECKING:
    from samplers import PlannedRun


@spread_options
@use_one_thread()
def plan_command(
    context: typer.Context,
    target: Annotated[
        str,
        typer.Argument(
            metavar="ENV|RUN",
            help="Environment, of which pilots are run; or the folder of a run.",
        ),
    ],
    options: QuestionOptions,
    cov: Annotated[
        float, typer.Option("--cov", "--target-cov", help="Coefficient of variation that is wished for.")
    ] = 0.1,
    ego: Annotated[str, typer.Option(help="An ego, as for estimate --ego.")] = "idm",
    pilot: Annotated[
        int | None, typer.Option(help="Simulations of each pilot.", show_default="the method's own budget")
    ] = None,
    algo: AlgoOption = None,
    stats: StatsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Plan simulations and wall time for a precision, by each of --method (joined by commas) and plain Monte Carlo."""
    from rare_envs.study.analysis.plan import plan_by_pilots, plan_from_result
    from rare_envs.study.corpus.storage import read_recorded
    from rare_envs.study.question import Question
    from samplers.validation import check_number

    with as_bad_input(ValueError):
        check_number("--cov", cov, 0.0, math.inf)  # before the pilots
    with keep_stdout_for_the_answer():
        if Path(target).is_dir():
            _refuse_options_of_pilots(context)
            found = plan_from_result(read_recorded(Path(target)), cov)
        else:
            arguments = options.arguments()
            methods = [name.strip() for name in str(arguments.pop("method")).split(",")]
            _check_environment(target)
            question = Question(env_id=target, ego=ego, algo=algo, stats=stats, max_sim=pilot, **arguments)
            found = plan_by_pilots(question, methods, cov, progress=True)
    if as_json:
        print_json({"target_cov": cov, "runs": [each.to_dict() for each in found]})
    else:
        _print_plan(found, cov)


def _check_environment(target: str) -> None:
    """Raise a BadInput unless a target, which is no folder, is the name of an environment."""
    from rare_envs.scenarios.registry import find_scenario

    try:
        find_scenario(target)
    except ValueError as error:
        raise BadInput(f"There is no folder {target!r} of a run. {error}") from error


def _refuse_options_of_pilots(context: typer.Context) -> None:
    """Refuse what was typed beside the folder of a run, which has a question of its own."""
    typed = sorted(name for name in context.params if is_typed(context, name))
    refused = [name for name in typed if name not in ("target", "cov", "as_json")]
    if refused:
        raise BadInput(f"Expected the folder of a run without --{refused[0].replace('_', '-')}: nothing is simulated.")


def _print_plan(found: tuple[PlannedRun, ...], cov: float) -> None:
    from rare_envs.study.analysis.plan import format_seconds

    print(f"For a c.o.v. of {cov:g} (--target-cov {cov:g}):")
    for each in found:
        time = "" if each.seconds is None else f", about {format_seconds(each.seconds)} at the pilot's speed"
        print(f"  {each.method:<12} {each.n_sim:>15,} simulations{time}")
