"""Commands of the command line `rare-envs`: each reads its options, calls one function and prints.

Exit codes: 0 done, 2 bad input (one line on standard error), 3 done with warnings that make the number doubtful; with
--max-p 0 passes, 4 fails, 5 undecided.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from rare_envs.study.cli.egos import (
    check_ego_command,
    export_ego_command,
    fit_command,
    serve_ego_command,
    train_drivers_command,
    train_ego_command,
)
from rare_envs.study.cli.estimate import estimate_command, plan_command, resume_command, show_report
from rare_envs.study.cli.examples import add_examples, format_examples
from rare_envs.study.cli.options import (
    AlgoOption,
    EgoArgument,
    EnvArgument,
    ForceOption,
    JsonOption,
    QuestionOptions,
    RiskOptions,
    StatsOption,
    read_count,
)
from rare_envs.study.cli.runs import corpus_app, export_command, replay_command, report_command
from rare_envs.study.cli.shell import (
    DOUBTFUL,
    OneLineErrors,
    SummarisedCommands,
    ignore_signals,
    keep_stdout_for_the_answer,
    print_json,
    require_driving,
    say_early_stop,
    show_what_is_known,
)
from rare_envs.study.errors import as_bad_input
from rare_envs.threads import use_one_thread
from rare_envs.version import __version__
from training.command_line import spread_options

app = typer.Typer(
    cls=OneLineErrors,
    help="How often does a driving policy crash? Train one, estimate its rare failures, see the most likely.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _print_version(wanted: bool) -> None:
    """Print the version and exit, where it is wanted."""
    if wanted:
        print(f"rare-envs {__version__}")
        raise typer.Exit


@app.callback()
def common_options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """How often does a driving policy crash? Train one, estimate its rare failures, see the most likely."""


@app.command("list")
def list_command(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="[WHAT]",
            help="environments, methods, egos, drivers, measures, weather, all, or an environment.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show the names of environments, methods, egos, drivers and measures; with one of these words, what they mean."""
    from rare_envs.study.cli.listing import check_kind, choose_entries, list_names, print_details, print_overview

    entries = list_names()
    chosen = None if what is None else check_kind(entries, what)
    if as_json:
        print_json(entries if chosen is None else choose_entries(entries, chosen))
    elif chosen is None:
        print_overview(entries)
    else:
        print_details(entries, chosen)


app.command("estimate")(estimate_command)


@app.command("risk")
@spread_options
@say_early_stop()
@use_one_thread()
def risk_command(
    ego: EgoArgument,
    options: RiskOptions,
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
        found = risk(ego, out=out, progress=True, force=force, **options.arguments())
    if as_json:
        print_json(found.to_dict())
    else:
        print(found if out is None else f"{found}\nWrote {out}.")
    raise typer.Exit(DOUBTFUL if found.warnings else 0)


@app.command("bases")
def bases_command(
    scenario: Annotated[
        str,
        typer.Argument(metavar="SCENARIO", help="Environment, or its short name: cut_in."),
    ],
    as_json: JsonOption = False,
) -> None:
    """List the base distributions of a scenario: events, site, family, fit, frequency and predictive checks."""
    from rare_envs.study.cli.listing import list_bases, print_bases, resolve_scenario

    with as_bad_input(ValueError):
        found = list_bases(scenario)
    if as_json:
        print_json({"scenario": scenario, "env_id": resolve_scenario(scenario), "bases": found})
    else:
        print_bases(resolve_scenario(scenario), found)


app.command("resume")(resume_command)


@app.command("compare")
@spread_options
@say_early_stop()
@use_one_thread()
def compare_command(
    ego_a: Annotated[
        str,
        typer.Argument(metavar="EGO_A", help="An ego, as for estimate --ego."),
    ],
    ego_b: Annotated[str, typer.Argument(metavar="EGO_B", help="The other ego.")],
    env: EnvArgument,
    options: QuestionOptions,
    max_sim: Annotated[
        int,
        typer.Option(
            help="Largest number of simulations, of both egos together.", parser=read_count, metavar="INTEGER"
        ),
    ] = 12_000,
    algo: AlgoOption = None,
    stats: StatsOption = None,
    algo_b: Annotated[str | None, typer.Option(help="As --algo, for the .zip of EGO_B.")] = None,
    stats_b: Annotated[str | None, typer.Option(help="As --stats, for the .zip of EGO_B.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for comparison.json and failures.csv.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate how many times likelier ego A fails than ego B, with an interval, from the same scenarios."""
    from rare_envs.study.compare import compare_egos
    from rare_envs.study.question import Question

    question = Question(env_id=env, ego=ego_a, max_sim=max_sim, algo=algo, stats=stats, **options.arguments())
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


app.command("fit")(fit_command)
app.command("train-ego")(train_ego_command)
app.command("train-drivers")(train_drivers_command)
app.command("export-ego")(export_ego_command)
app.command("replay")(replay_command)
app.command("export")(export_command)
app.add_typer(corpus_app, name="corpus", cls=SummarisedCommands)
app.command("plan")(plan_command)
app.command("report")(report_command)
app.command("check-ego")(check_ego_command)
app.command("serve-ego")(serve_ego_command)


require_driving(app)
add_examples(app)
app.info.epilog = format_examples("")


def main() -> None:
    """Run the command line; alone, it shows its help."""
    try:
        app(sys.argv[1:] or ["--help"], prog_name="rare-envs")
    finally:
        ignore_signals()


if __name__ == "__main__":
    main()
