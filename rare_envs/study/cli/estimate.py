"""Commands that estimate: `estimate`, `resume`, `risk`, `compare` and `plan`."""

from __future__ import annotations

import math
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from rare_envs.scenarios.registry import find_scenario, is_highway_env_id
from rare_envs.study.arguments import ExecutorOptions, Question
from rare_envs.study.cli.options import (
    ASKED,
    DEFAULT_BUDGET,
    EGO_FILE,
    EVERYTHING,
    DetailsOption,
    EgoArgument,
    EnvArgument,
    ForceOption,
    JsonOption,
    count_option,
    take_options,
)
from rare_envs.study.cli.shell import (
    DOUBTFUL,
    keep_stdout_for_the_answer,
    list_typed,
    print_json,
    print_whole,
    say_early_stop,
    show_what_is_known,
)
from rare_envs.study.errors import BadInput, as_bad_input, output_folder
from rare_envs.threads import use_one_thread

if TYPE_CHECKING:
    from samplers import Estimate, Executor, PlannedRun

GATE_CODES = {"passes": 0, "fails": 4, "undecided": 5}
"""Exit codes of a comparison of p with a limit."""
LEADER_SCENARIOS = {"cut-in": "cut_in", "car-following": "car_following"}
"""Scenarios in which the ego gets a new leader; each is run beside the hard brake, and they count nothing twice."""
OPTIONS = frozenset(
    "env ego algo stats trust method measure gamma seed max_sim target_cov replicates on_error noise horizon chunk "
    "workers executor address time_limit memory_limit config out force as_json".split()
)
"""Parameters of the command that HighwayEnv's environments have; the others are of the batched simulation."""
ESTIMATE_FILE = "estimate.safetensors"
"""File in the folder of `--out`; `samplers.Estimate.load` reads it."""
HELD = "HighwayEnv's environment as it is: what it holds fixed is held; rare_envs.highway_env_problem varies it too"
"""Condition of p."""


@take_options(*EVERYTHING, executor=True)
@say_early_stop()
@use_one_thread()
def estimate_command(
    context: typer.Context,
    asked: dict[str, Any],
    places: dict[str, Any],
    env: Annotated[
        str | None, typer.Argument(metavar="ENV", help="Environment, such as rare_envs/CutIn-v0; or in --config.")
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
    from rare_envs.study.question_file import join_options, join_question, read_question_file

    typed = list_typed(context)
    given = {} if config is None else read_question_file(config)
    of_executor = {name: value for name in places if (value := given.pop(name, None)) is not None}
    executors = ExecutorOptions(**join_options(of_executor, places, typed))
    question = join_question(given, env, asked, typed)
    if question.max_p is None:
        _refuse_options_of_a_limit(typed | set(given))
    if is_highway_env_id(question.env_id):
        _answer_highway_env(question, typed, out, force, as_json, executors)
    with show_what_is_known(lambda known: show_report(known, None, as_json, details)), keep_stdout_for_the_answer():
        with as_bad_input(ValueError):
            executor = executors.make()
        study = prepare(question)
        report = (
            run(study, progress=True, executor=executor)
            if out is None
            else run_into(out, study, progress=True, force=force, executor=executor)
        )
    _answer(report, out, as_json, details)


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
    from rare_envs.study.text import print_report

    if as_json:
        print_json(report.to_dict())
    else:
        print_report(report, out, details)
        if not details:
            where = "--details" if out is None else f"rare-envs report {shlex.quote(str(out))}"
            print(f"all intervals and parameters: {where}")


@take_options("trust", executor=True)
@say_early_stop("Stopped before the run went on; what it had kept is still there.")
@use_one_thread()
def resume_command(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of an estimate --out that has not come to its end.")
    ],
    asked: dict[str, Any],
    places: dict[str, Any],
    ego: Annotated[str | None, typer.Option(help="New address of an ego in another program, tcp://...")] = None,
    on_error: Annotated[str | None, typer.Option(help="Instead of what the run had: raise, failure or bound.")] = None,
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
            executor = ExecutorOptions(**places).make()
        report = resume(run, ego, on_error, progress=True, mend=mend, executor=executor, **asked)
    _answer(report, run, as_json, details)


@take_options(*ASKED, *EGO_FILE)
@use_one_thread()
def plan_command(
    context: typer.Context,
    target: Annotated[
        str, typer.Argument(metavar="ENV|RUN", help="Environment, of which pilots are run; or the folder of a run.")
    ],
    asked: dict[str, Any],
    cov: Annotated[
        float, typer.Option("--cov", "--target-cov", help="Coefficient of variation that is wished for.")
    ] = 0.1,
    ego: Annotated[str, typer.Option(help="An ego, as for estimate --ego.")] = "idm",
    pilot: Annotated[
        int | None, typer.Option(help="Simulations of each pilot.", show_default="the method's own budget")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Plan simulations and wall time for a precision, by each of --method (joined by commas) and plain Monte Carlo."""
    from rare_envs.study.plan import plan_by_pilots, plan_from_result
    from rare_envs.study.recorded_question import load_finished
    from samplers.validation import check_number

    with as_bad_input(ValueError):
        check_number("--cov", cov, 0.0, math.inf)  # before the pilots
    with keep_stdout_for_the_answer():
        if Path(target).is_dir():
            _refuse_options_of_pilots(context)
            found = plan_from_result(load_finished(Path(target)).result, cov)
        else:
            methods = [name.strip() for name in asked.pop("method").split(",")]
            _check_environment(target)
            question = Question(env_id=target, ego=ego, max_sim=pilot, **asked)
            found = plan_by_pilots(question, methods, cov, progress=True)
    if as_json:
        print_json({"target_cov": cov, "runs": [each.to_dict() for each in found]})
    else:
        _print_plan(found, cov)


def _check_environment(target: str) -> None:
    """Raise a BadInput unless a target, which is no folder, is the name of an environment."""
    try:
        find_scenario(target)
    except ValueError as error:
        raise BadInput(f"There is no folder {target!r} of a run. {error}") from error


def _refuse_options_of_pilots(context: typer.Context) -> None:
    """Refuse what was typed beside the folder of a run, which has a question of its own."""
    refused = sorted(list_typed(context) - {"target", "cov", "as_json"})
    if refused:
        raise BadInput(f"Expected the folder of a run without --{refused[0].replace('_', '-')}: nothing is simulated.")


def _print_plan(found: tuple[PlannedRun, ...], cov: float) -> None:
    from rare_envs.study.plan import format_seconds

    print(f"For a c.o.v. of {cov:g} (--target-cov {cov:g}):")
    for each in found:
        time = "" if each.seconds is None else f", about {format_seconds(each.seconds)} at the pilot's speed"
        print(f"  {each.method:<12} {each.n_sim:>15,} simulations{time}")


@take_options("method", "ensemble_run", "device", "seed", *EGO_FILE, "trust", "observation", "action")
@say_early_stop()
@use_one_thread()
def risk_command(
    ego: EgoArgument,
    asked: dict[str, Any],
    leaders: Annotated[
        str, typer.Option("--with", help="Scenario of new leaders beside hard brake: cut-in or car-following.")
    ] = "cut-in",
    sites: Annotated[
        str,
        typer.Option(help="Site of the bases, us101 or i80; both, joined by a comma, for the spread between sites."),
    ] = "us101",
    base: Annotated[
        list[str] | None, typer.Option(help="SCENARIO=NAME or FILE, in place of the site's base; may be repeated.")
    ] = None,
    max_sim: Annotated[
        int | None, count_option("Largest number of simulations of each scenario.", show_default=DEFAULT_BUDGET)
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for risk.json, risk.png and a run of each scenario.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate collisions per million km, summed over scenarios, with an interval."""
    from rare_envs.study.risk import risk

    with (
        show_what_is_known(lambda known: show_report(known, None, as_json)),
        keep_stdout_for_the_answer(),
        as_bad_input(ValueError),
    ):
        found = risk(
            ego,
            scenarios=(_find_leader_scenario(leaders), "hard_brake"),
            sites=[site.strip() for site in sites.split(",") if site.strip()],
            bases=_read_bases(base or []),
            out=out,
            progress=True,
            force=force,
            max_sim=max_sim,
            **asked,
        )
    if as_json:
        print_json(found.to_dict())
    else:
        print(found if out is None else f"{found}\nWrote {out}.")
    raise typer.Exit(DOUBTFUL if found.warnings else 0)


def _read_bases(words: list[str]) -> dict[str, str]:
    """Return base distributions by scenario, from words such as cut_in=i80."""
    found: dict[str, str] = {}
    for scenario, _, base in (word.partition("=") for word in words):
        if not scenario or not base:
            raise ValueError(f"Expected --base SCENARIO=NAME, such as cut_in=i80, got {scenario!r} alone.")
        if scenario in found:
            raise ValueError(f"Expected one --base for each scenario, got several for {scenario!r}.")
        found[scenario] = base
    return found


def _find_leader_scenario(leaders: str) -> str:
    if leaders not in LEADER_SCENARIOS:
        raise ValueError(
            f"Expected --with {' or --with '.join(LEADER_SCENARIOS)}, got {leaders!r}: the sum is that of the hard "
            "brake and one scenario of new leaders, whose events were counted and are not in it twice."
        )
    return LEADER_SCENARIOS[leaders]


@take_options(*ASKED, *EGO_FILE)
@say_early_stop()
@use_one_thread()
def compare_command(
    ego_a: Annotated[str, typer.Argument(metavar="EGO_A", help="An ego, as for estimate --ego.")],
    ego_b: Annotated[str, typer.Argument(metavar="EGO_B", help="The other ego.")],
    env: EnvArgument,
    asked: dict[str, Any],
    max_sim: Annotated[int, count_option("Largest number of simulations, of both egos together.")] = 12_000,
    algo_b: Annotated[str | None, typer.Option(help="As --algo, for the .zip of EGO_B.")] = None,
    stats_b: Annotated[str | None, typer.Option(help="As --stats, for the .zip of EGO_B.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for comparison.json and failures.csv.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate how many times likelier ego A fails than ego B, with an interval, from the same scenarios."""
    from rare_envs.study.compare import compare_egos

    question = Question(env_id=env, ego=ego_a, max_sim=max_sim, **asked)
    with show_what_is_known(print), keep_stdout_for_the_answer():
        comparison = compare_egos(question, ego_b, progress=True, out=out, force=force, algo_b=algo_b, stats_b=stats_b)
    if as_json:
        print_json(comparison.answer)
    else:
        notes = "".join(f"\n  note: {note}" for note in comparison.answer["notes"])
        print(f"A = {ego_a}, B = {ego_b}, {env}\n{comparison.comparison}{notes}")
        if out is not None:
            print(f"Wrote {out}.")
    raise typer.Exit(DOUBTFUL if comparison.comparison.warnings else 0)


def _answer_highway_env(
    question: Question, typed: set[str], out: Path | None, force: bool, as_json: bool, executors: ExecutorOptions
) -> NoReturn:
    """Estimate in an environment of HighwayEnv, print the answer and exit."""

    def show(answer: dict[str, Any], where: str = "") -> None:
        text = answer.pop("text")
        if as_json:
            print_json(answer)
        else:
            print(f"{text}{where}")

    with show_what_is_known(show), keep_stdout_for_the_answer(), as_bad_input(ValueError):
        answer = estimate_highway_env(question, typed, out, force, executors.make())
    print_whole(lambda: show(answer, "" if out is None else f"\nWrote {out}."))
    raise typer.Exit(DOUBTFUL if answer["doubtful"] else 0)


def estimate_highway_env(
    question: Question, typed: set[str], out: Path | None, force: bool, executor: Executor | None
) -> dict[str, Any]:
    """Estimate how often an ego crashes in one of HighwayEnv's environments, as that environment draws its traffic."""
    import agents
    import rare_envs
    import samplers
    from rare_envs.study.interruption import FIRST_BATCH, RunInterrupted, describe_stop

    refused = sorted(typed - OPTIONS)
    if refused:
        raise BadInput(
            f"{question.env_id!r} is an environment of HighwayEnv, which has no --{refused[0].replace('_', '-')}; "
            f"expected {', '.join(rare_envs.ENV_IDS)} with it."
        )
    file = None if out is None else out / ESTIMATE_FILE
    if file is not None and file.exists() and not force:
        raise BadInput(f"There is a finished run in {str(out)!r} ({ESTIMATE_FILE}): replace it by --force.")
    with as_bad_input(ValueError, OSError, TypeError):
        samplers.get_method(question.method)
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        settings: dict[str, Any] = {} if question.horizon is None else {"horizon": question.horizon}
        problem = rare_envs.highway_env_problem(
            question.env_id, ego, measure=question.measure, noise=question.noise, fixed="highway_env", **settings
        )
        try:
            with problem:
                result = samplers.estimate(
                    problem, question.method, progress=True, executor=executor, **_read_arguments(question)
                )
        except samplers.EstimationInterrupted as stopped:
            known = _describe(question, problem, stopped.estimate)
            raise RunInterrupted(describe_stop(stopped.estimate), known) from None
        except KeyboardInterrupt:
            raise RunInterrupted(FIRST_BATCH) from None
    if file is not None:
        with output_folder(file.parent):
            result.save(file)
    return _describe(question, problem, result)


def _read_arguments(question: Question) -> dict[str, Any]:
    """Return the arguments of `samplers.estimate` that a question has."""
    names = ("gamma", "seed", "max_sim", "target_cov", "replicates", "on_error")
    return {name: getattr(question.run_arguments, name) for name in names}


def _describe(question: Question, problem: Any, result: Estimate) -> dict[str, Any]:
    """Return the answer, JSON-ready."""
    from rare_envs.study.report import has_exact_bound

    shown = result
    if has_exact_bound(result):  # the warning that nothing failed casts no doubt on the upper end
        shown = replace(result, warnings=(), remarks=(*result.warnings, *result.remarks))
    lines = [f"{question.env_id}, ego {question.ego}", str(shown), f"  given {HELD}"]
    likeliest = {}
    if len(result.failures):
        likeliest = {name: _as_plain(value) for name, value in problem.space.named(result.failures.x[0]).items()}
        lines.append(f"  most likely failure: {', '.join(f'{name} {value}' for name, value in likeliest.items())}")
    about = {"env_id": question.env_id, "ego": question.ego, "given": HELD, "most_likely": likeliest}
    return {**result.to_dict(), **about, "doubtful": bool(shown.warnings), "text": "\n".join(lines)}


def _as_plain(value: Any) -> Any:
    """Return a number, or a list of such, with three decimals."""
    import numpy as np

    return np.round(value, 3).tolist()
