"""Commands `estimate` and `resume`: one evaluation, and the rest of one that was stopped."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from rare_envs.scenarios.registry import is_highway_env_id
from rare_envs.study.cli.executor_options import ExecutorOptions
from rare_envs.study.cli.options import (
    DetailsOption,
    EstimateOptions,
    ForceOption,
    JsonOption,
    TrustOption,
)
from rare_envs.study.cli.shell import (
    DOUBTFUL,
    is_typed,
    keep_stdout_for_the_answer,
    print_json,
    print_whole,
    say_early_stop,
    show_what_is_known,
)
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.threads import use_one_thread
from training.command_line import spread_options

if TYPE_CHECKING:
    from rare_envs.study.question import Question

GATE_CODES = {"passes": 0, "fails": 4, "undecided": 5}
"""Exit codes of a comparison of p with a limit."""


@spread_options
@say_early_stop()
@use_one_thread()
def estimate_command(
    context: typer.Context,
    options: EstimateOptions,
    places: ExecutorOptions,
    env: Annotated[
        str | None,
        typer.Argument(
            metavar="ENV",
            help="Environment, such as rare_envs/CutIn-v0; or in --config.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML file with ENV (env: ...) and options; those given here come first.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the run: result.json, episodes.parquet and more.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    details: DetailsOption = False,
) -> None:
    """Estimate how often an ego fails, with an interval, and show its most likely failure."""
    from rare_envs.study.evaluate import run, run_into
    from rare_envs.study.question import prepare
    from rare_envs.study.storage.question_file import EXECUTOR_KEYS, join_question, read_question_file

    typed = {name for name in context.params if is_typed(context, name)}
    given = {} if config is None else read_question_file(config)
    with as_bad_input(ValueError):
        places = places.fill({name: given.pop(name) for name in EXECUTOR_KEYS if name in given}, typed)
    question = join_question(given, env, options.arguments(), typed)
    if question.max_p is None:
        _refuse_options_of_a_limit(typed | set(given))
    if is_highway_env_id(question.env_id):
        _estimate_highway_env(question, typed, out, force, as_json, places)
    with show_what_is_known(lambda known: show_report(known, None, as_json, details)), keep_stdout_for_the_answer():
        with as_bad_input(ValueError):
            executor = places.make()
        study = prepare(question)
        report = (
            run(study, progress=True, executor=executor)
            if out is None
            else run_into(out, study, progress=True, force=force, executor=executor)
        )
    _answer(report, out, as_json, details)


def _estimate_highway_env(
    question: Question, typed: set[str], out: Path | None, force: bool, as_json: bool, places: ExecutorOptions
) -> NoReturn:
    """Estimate in an environment of HighwayEnv, print the answer and exit."""
    from rare_envs.study.cli.highway_env import estimate_highway_env

    def show(answer: dict[str, Any], where: str = "") -> None:
        text = answer.pop("text")
        if as_json:
            print_json(answer)
        else:
            print(f"{text}{where}")

    with show_what_is_known(show), keep_stdout_for_the_answer(), as_bad_input(ValueError):
        answer = estimate_highway_env(question, typed, out, force, places.make())
    print_whole(lambda: show(answer, "" if out is None else f"\nWrote {out}."))
    raise typer.Exit(DOUBTFUL if answer["doubtful"] else 0)


def _refuse_options_of_a_limit(typed: set[str]) -> None:
    """Refuse options that a question without --max-p would ignore."""
    for name, option in (("given_base", "--given-base"), ("gate_confidence", "--confidence")):
        if name in typed:
            raise BadInput(f"Expected {option} together with --max-p, the limit of p.")


def _answer(report: Any, out: Path | None, as_json: bool, details: bool) -> NoReturn:
    """Print a report and exit."""
    print_whole(lambda: show_report(report, out, as_json, details))
    if report.verdict is not None:
        raise typer.Exit(GATE_CODES[report.verdict.decision])
    raise typer.Exit(DOUBTFUL if report.doubtful else 0)


def show_report(report: Any, out: Path | None, as_json: bool, details: bool = False) -> None:
    """Print a report."""
    from rare_envs.study.cli.printing import print_report

    if as_json:
        print_json(report.to_dict())
    else:
        print_report(report, out, details)
        if not details:
            where = "--details" if out is None else f"rare-envs report {shlex.quote(str(out))}"
            print(f"all intervals and parameters: {where}")


@spread_options
@say_early_stop("Stopped before the run went on; what it had kept is still there.")
@use_one_thread()
def resume_command(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of an estimate --out that has not come to its end.")
    ],
    places: ExecutorOptions,
    ego: Annotated[str | None, typer.Option(help="New address of an ego in another program, tcp://...")] = None,
    on_error: Annotated[str | None, typer.Option(help="Instead of what the run had: raise, failure or bound.")] = None,
    trust: TrustOption = False,
    mend: Annotated[
        bool, typer.Option("--mend", help="Of a damaged journal, keep the simulations before the damage.")
    ] = False,
    as_json: JsonOption = False,
    details: DetailsOption = False,
) -> None:
    """Continue an interrupted run; the result is the same as without the interruption."""
    from rare_envs.study.evaluate import resume

    with show_what_is_known(lambda known: show_report(known, None, as_json, details)), keep_stdout_for_the_answer():
        with as_bad_input(ValueError):
            executor = places.make()
        report = resume(run, ego, on_error, trust, progress=True, mend=mend, executor=executor)
    _answer(report, run, as_json, details)
