"""Commands of the command line `rare-envs`: each reads its options, calls one function and prints.

Exit codes: 0 done, 2 bad input (one line on standard error), 3 done with warnings that make the number doubtful; with
--max-p 0 passes, 4 fails, 5 undecided.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from rare_envs.study.cli.commands.bench import bench_app
from rare_envs.study.cli.commands.corpus import corpus_app, replay_all
from rare_envs.study.cli.commands.export_failure import export_command
from rare_envs.study.cli.commands.plan import plan_command
from rare_envs.study.cli.commands.report import report_command
from rare_envs.study.cli.executor_options import ExecutorOptions
from rare_envs.study.cli.options import (
    AlgoOption,
    EgoArgument,
    EnvArgument,
    EstimateOptions,
    ForceOption,
    JsonOption,
    NoiseChoice,
    QuestionOptions,
    RiskOptions,
    ScenarioOptions,
    SeedOption,
    StatsOption,
    TrustOption,
    WorldOptions,
    read_count,
)
from rare_envs.study.cli.shell import (
    OneLineErrors,
    is_typed,
    keep_stdout_for_the_answer,
    print_json,
    show_what_is_known,
)
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.threads import use_one_thread
from rare_envs.version import __version__
from training.command_line import DriverTrainingOptions, RecordingOptions, RunFolderOption, spread_options

DOUBTFUL = 3
GATE_CODES = {"passes": 0, "fails": 4, "undecided": 5}
"""Exit codes of a comparison of p with a limit."""

app = typer.Typer(
    cls=OneLineErrors,
    help="How often does a driving policy crash? Train one, estimate its rare failures, see the most likely.",
    add_completion=False,
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
def list_command(as_json: JsonOption = False) -> None:
    """Show environments with their parameters, methods, egos, measures and base distributions."""
    from rare_envs.study.cli.catalogue import list_names
    from rare_envs.study.cli.printing import print_catalogue

    if as_json:
        print_json(list_names())
    else:
        print_catalogue(list_names())


@app.command("estimate")
@spread_options
@use_one_thread()
def estimate_command(
    context: typer.Context,
    options: EstimateOptions,
    places: ExecutorOptions,
    env: Annotated[
        str | None, typer.Argument(metavar="ENV", help="Environment, such as rare_envs/CutIn-v0; or in --config.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML file with ENV (env: ...) and options; those given here come first.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the run: result.json, episodes.parquet and more.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate how often an ego fails, with an interval, and show its most likely failure."""
    from rare_envs.study.evaluate import run, run_into
    from rare_envs.study.question import prepare
    from rare_envs.study.storage.question_file import join_question, read_question_file

    typed = {name for name in context.params if is_typed(context, name)}
    question = join_question({} if config is None else read_question_file(config), env, options.arguments(), typed)
    if question.max_p is None:
        _refuse_options_of_a_limit(typed)
    with show_what_is_known(lambda known: _show(known, None, as_json)), keep_stdout_for_the_answer():
        with as_bad_input(ValueError):
            executor = places.make()
        study = prepare(question)
        report = (
            run(study, progress=True, executor=executor)
            if out is None
            else run_into(out, study, progress=True, force=force, executor=executor)
        )
    _answer(report, out, as_json)


def _refuse_options_of_a_limit(typed: set[str]) -> None:
    """Refuse options that a question without --max-p would ignore.

    Raises:
        BadInput: One was typed. A folder of an older run may have them, so that the question itself allows them.
    """
    for name, option in (("given_base", "--given-base"), ("gate_confidence", "--confidence")):
        if name in typed:
            raise BadInput(f"Expected {option} together with --max-p, the limit of p.")


def _answer(report: Any, out: Path | None, as_json: bool) -> NoReturn:
    """Print a report and exit."""
    _show(report, out, as_json)
    if report.verdict is not None:
        raise typer.Exit(GATE_CODES[report.verdict.decision])
    raise typer.Exit(DOUBTFUL if report.doubtful else 0)


def _show(report: Any, out: Path | None, as_json: bool) -> None:
    """Print a report."""
    from rare_envs.study.cli.printing import print_report

    if as_json:
        print_json(report.to_dict())
    else:
        print_report(report, out)


@app.command("risk")
@spread_options
@use_one_thread()
def risk_command(
    ego: EgoArgument,
    options: RiskOptions,
    out: Annotated[Path | None, typer.Option(help="Folder for risk.json, risk.png and a run of each scenario.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate collisions per million km, over scenarios that count nothing twice, with an honest interval."""
    from rare_envs.study.rates.total_risk import risk

    with (
        show_what_is_known(lambda known: _show(known, None, as_json)),
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
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="Environment, or its short name: cut_in.")],
    as_json: JsonOption = False,
) -> None:
    """List the base distributions of a scenario: events, site, family, fit, frequency and predictive checks."""
    from rare_envs.study.cli.base_table import list_bases, print_bases, resolve_scenario

    with as_bad_input(ValueError):
        found = list_bases(scenario)
    if as_json:
        print_json({"scenario": scenario, "env_id": resolve_scenario(scenario), "bases": found})
    else:
        print_bases(resolve_scenario(scenario), found)


@app.command("resume")
@spread_options
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
) -> None:
    """Go on with a run whose ego has gone, or that was stopped; the answer is that of an undisturbed run."""
    from rare_envs.study.evaluate import resume

    with show_what_is_known(lambda known: _show(known, None, as_json)), keep_stdout_for_the_answer():
        with as_bad_input(ValueError):
            executor = places.make()
        report = resume(run, ego, on_error, trust, progress=True, mend=mend, executor=executor)
    _answer(report, run, as_json)


@app.command("compare")
@spread_options
@use_one_thread()
def compare_command(
    ego_a: Annotated[str, typer.Argument(metavar="EGO_A", help="An ego, as for estimate --ego.")],
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
    with keep_stdout_for_the_answer():
        comparison = compare_egos(question, ego_b, progress=True, out=out, force=force, algo_b=algo_b, stats_b=stats_b)
    if as_json:
        print_json(comparison.answer)
    else:
        notes = "".join(f"\n  note: {note}" for note in comparison.answer["notes"])
        print(f"A = {ego_a}, B = {ego_b}, {env}\n{comparison.comparison}{notes}")
        if out is not None:
            print(f"Wrote {out}.")
    raise typer.Exit(DOUBTFUL if comparison.comparison.warnings else 0)


@app.command("train-ego")
@spread_options
@use_one_thread()
def train_ego_command(
    env: EnvArgument,
    options: WorldOptions,
    algo: Annotated[str, typer.Option(help="Stable-Baselines3 algorithm.")] = "ppo",
    steps: Annotated[int, typer.Option(help="Environment steps to train for.")] = 200_000,
    out: Annotated[Path, typer.Option(help="File to save the ego in.")] = Path("ego.zip"),
    seed: SeedOption = 0,
    num_envs: Annotated[int, typer.Option(help="Episodes that run side by side.")] = 256,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a training that was interrupted.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Train an ego on the batched simulation and save it for `rare-envs estimate --ego`."""
    from training import train_ego

    world = {**options.arguments(), "observation": options.observation or "features"}
    with as_bad_input(ValueError, OSError):
        path = train_ego(env, algo=algo, steps=steps, out=out, seed=seed, num_envs=num_envs, resume=resume, **world)
    if as_json:
        print_json({"ego": str(path), "env_id": env, "algo": algo, "steps": steps, "seed": seed, **world})
    else:
        print(f"Saved {path}. Next: rare-envs estimate {env} --ego {path}{_estimate_options(world, options.noise)}")


def _estimate_options(world: dict[str, Any], noise: NoiseChoice) -> str:
    """Return the options with which `estimate` makes the world that an ego was trained in."""
    usual = {"noise": NoiseChoice.ON.value, "observation": "features", "action": "continuous"}
    values = {**world, "noise": noise.value, "weather": None}
    words = [f" --{name} {value}" for name, value in values.items() if value not in (None, usual.get(name))]
    return "".join(words) + (" --weather" if world["weather"] else "")


@app.command("train-drivers")
@spread_options
@use_one_thread()
def train_drivers_command(
    out: RunFolderOption, recordings: RecordingOptions, options: DriverTrainingOptions, as_json: JsonOption = False
) -> None:
    """Train background drivers from recorded traffic; `python -m training.imitation.train` has every setting."""
    from training.imitation.algorithms.config import Config
    from training.imitation.datasets import Source
    from training.imitation.run_folder import train_driver

    method = options.method.value
    with as_bad_input(ValueError):
        config = Config(method, options.seed, options.updates)  # type: ignore[arg-type]  # the options are its methods
        path = train_driver(Source(*recordings.kind_and_path()), config, out, progress=True)
    if as_json:
        print_json({"driver": str(path), "method": method, "seed": options.seed})
    else:
        print(f"Saved {path}. Load it with agents.load_driver({str(path)!r}).")


@app.command("export-ego")
def export_ego_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A .zip saved by Stable-Baselines3.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The .onnx file to write.")],
    algo: AlgoOption = None,
    stats: StatsOption = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a saved policy as ONNX, normalisation, memory and clipping included, and check that both act alike."""
    from rare_envs.study.cli.commands.export_ego import export_ego

    with keep_stdout_for_the_answer():
        done = export_ego(model, out, algo=algo, trust=trust, stats=stats)
    if as_json:
        print_json(done)
    else:
        print(
            f"Wrote {out}: its actions differ by {done['largest_difference']:.1e} at most "
            f"on {done['observations_tried']:,} random observations."
        )


@app.command("replay")
@use_one_thread()
def replay_command(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")],
    failure: Annotated[int, typer.Option(help="Which failure; 0 is the most likely.")] = 0,
    out: Annotated[Path | None, typer.Option(help="A .gif of the drive, or a .png of its worst moment.")] = None,
    ego: Annotated[
        str | None, typer.Option(help="Another ego, as for estimate --ego, in the place of the run's.")
    ] = None,
    replay_each: Annotated[
        bool, typer.Option("--all", help="Simulate all failures again and compare their f; without a film.")
    ] = False,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Drive a failure that a run has found again, and show it with its measure over time."""
    from rare_envs.study.corpus.trial import find_for_ego
    from rare_envs.study.replay import drive_again
    from rare_envs.study.video import REPLAY_TOLERANCE, check_film_path, describe_drive, find_failure, write_film

    if replay_each:
        if out is not None:
            raise BadInput("Expected --all without --out: a film shows one failure.")
        if is_typed(context, "failure"):
            raise BadInput("Expected --all without --failure: it simulates all of them.")
        replay_all(run, ego, trust, as_json)
    if out is not None:
        check_film_path(out)
    with keep_stdout_for_the_answer():
        recorded = find_failure(run, failure, trust) if ego is None else find_for_ego(run, failure, ego, trust)
        drive = drive_again(recorded.problem, recorded.x)
        if out is not None:
            write_film(out, drive)
    same = abs(drive.f - recorded.f) <= REPLAY_TOLERANCE
    answer = {
        "failure": failure,
        "failures": recorded.n_failures,
        "f": drive.f,
        "f_recorded": recorded.f,
        "same": same,
        "log_p0": recorded.log_p0,
        "seconds": float(drive.time[-1]),
        "crash": drive.crash,
        "out": None if out is None else str(out),
        "ego": ego,
    }
    if as_json:
        print_json(answer)
    else:
        print("\n".join(describe_drive(recorded, drive, failure, ego)))
        if out is not None:
            print(f"Wrote {out}.")
    raise typer.Exit(0 if same or ego is not None else DOUBTFUL)


app.command("export")(export_command)
app.add_typer(corpus_app, name="corpus")
app.add_typer(bench_app, name="bench")
app.command("plan")(plan_command)
app.command("report")(report_command)


@app.command("check-ego")
@spread_options
def check_ego_command(
    ego: EgoArgument,
    env: EnvArgument,
    options: ScenarioOptions,
    algo: AlgoOption = None,
    stats: StatsOption = None,
    trust: TrustOption = False,
    time_limit: Annotated[float, typer.Option(help="Seconds that one check may take.")] = 30.0,
    as_json: JsonOption = False,
) -> None:
    """Check in seconds whether an ego fits: spaces, normalisation, determinism, memory, speed. 2: it does not."""
    from dataclasses import asdict

    from rare_envs.study.ego_check.findings import exit_code
    from rare_envs.study.ego_check.subprocess_check import EgoCheckRequest, check_ego
    from rare_envs.study.ego_check.table import VERDICTS, print_findings

    request = EgoCheckRequest(ego, env, algo, trust, stats=stats, time_limit=time_limit, **options.arguments())
    findings = check_ego(request)
    code = exit_code(findings)
    if as_json:
        print_json(
            {"ego": ego, "env_id": env, "verdict": VERDICTS[code], "findings": [asdict(each) for each in findings]}
        )
    else:
        print_findings(findings, f"{ego} in {env}")
    raise typer.Exit(code)


@app.command("serve-ego")
@use_one_thread()
def serve_ego_command(
    ego: EgoArgument,
    bind: Annotated[
        str, typer.Option(help="Address; beyond 127.0.0.1 it needs RARE_ENVS_SECRET.")
    ] = "tcp://127.0.0.1:5555",
    algo: AlgoOption = None,
    stats: StatsOption = None,
    trust: TrustOption = False,
) -> None:
    """Lend an ego to simulations in other processes or on other machines (estimate --ego tcp://...)."""
    from rare_envs.study.cli.commands.serve_ego import serve_ego

    serve_ego(ego, bind, algo=algo, trust=trust, stats=stats)


def main() -> None:
    """Run the command line; alone, it shows its help."""
    app(sys.argv[1:] or ["--help"], prog_name="rare-envs")


if __name__ == "__main__":
    main()
