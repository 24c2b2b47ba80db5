"""Commands about a finished run: `report`, `replay`, `export` and `corpus`."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rare_envs.study.cli.options import EGO_FILE, JsonOption, RunArgument, TrustOption, take_options
from rare_envs.study.cli.shell import DOUBTFUL, is_typed, keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, as_bad_input, output_file
from rare_envs.threads import use_one_thread

if TYPE_CHECKING:
    from rare_envs.study.corpus import Trial


@use_one_thread()
def report_command(
    run: RunArgument,
    out: Annotated[Path | None, typer.Option(help="The .html file; report.html in RUN by default.")] = None,
    events: Annotated[
        Path | None,
        typer.Option(help="CSV of recorded events, with columns named as the parameters: how near they come."),
    ] = None,
    figures: Annotated[str | None, typer.Option(help="Figures as files too, beside the page: svg, pdf or png.")] = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the report of a run as one HTML file, with its failures by mode, driven again and filmed."""
    from rare_envs.study.html_report import write_html_report

    with keep_stdout_for_the_answer():
        written = write_html_report(run, trust, events, out, figures)
    if as_json:
        print_json({"report": str(written[0]), "figures": [str(path) for path in written[1:]]})
    else:
        print(f"Wrote {written[0]}{f' and {len(written) - 1} figures' if written[1:] else ''}.")


FAILS = 4
"""Exit code where the ego fails in a stored scenario, as where p is above a limit."""
CorpusOption = Annotated[Path, typer.Option(help="Folder of the corpus.")]


def corpus_add_command(
    run: RunArgument,
    corpus: CorpusOption = Path("corpus"),
    most: Annotated[int, typer.Option(help="Failures to add: the most likely, and one of each kind of crash.")] = 20,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Add the failures of a run to a corpus, a file each, named by what is in it."""
    from rare_envs.study.corpus import add_run

    with keep_stdout_for_the_answer():
        chosen, new = add_run(run, corpus, most, trust)
    if as_json:
        print_json({"corpus": str(corpus), "added": new, "failures": [each.key for each in chosen]})
    else:
        print(f"Added {new} of {len(chosen)} failures to {corpus}{'' if new else '; it had all of them'}.")


@take_options(*EGO_FILE, "observation", "action", "trust")
@use_one_thread()
def corpus_run_command(
    ego: Annotated[str, typer.Option(help="The ego to try, as for estimate --ego.")],
    asked: dict[str, Any],
    corpus: CorpusOption = Path("corpus"),
    junit: Annotated[Path | None, typer.Option(help="File for a JUnit report.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Try an ego in all scenarios of a corpus. Exit code 0: it fails in none; 4: it does."""
    from rare_envs.study.corpus import EgoChoice, read_corpus, try_ego, write_junit

    trust, choice = asked.pop("trust"), EgoChoice(ego=ego, **asked)
    with keep_stdout_for_the_answer(), contextlib.nullcontext() if junit is None else output_file(junit):
        trials, seconds = try_ego(read_corpus(corpus), choice, corpus, trust)
        if junit is not None:
            try:
                write_junit(junit, trials, ego, seconds)
            except OSError as error:
                raise BadInput(f"Cannot write {str(junit)!r}: {error.strerror or error}.") from error
    _answer_trials(trials, ego, seconds, as_json)


def replay_all(run: Path, ego: str | None, trust: bool, as_json: bool) -> None:
    """Simulate all failures that a run has recorded again, with its ego or another, print them and exit."""
    from rare_envs.study.corpus import EgoChoice, read_run, repeat_run, try_ego

    with keep_stdout_for_the_answer():
        failures = read_run(run, trust)
        if not failures:
            raise BadInput(f"The run in {str(run)!r} has no failure.")
        trials, seconds = repeat_run(run, trust) if ego is None else try_ego(failures, EgoChoice(ego=ego), run, trust)
    if ego is not None:
        _answer_trials(trials, ego, seconds, as_json)
    different = [trial for trial in trials if not trial.same]
    if as_json:
        print_json(_describe_trials(trials, seconds) | {"same": len(trials) - len(different)})
    else:
        print(
            f"{len(trials) - len(different):,} of {len(trials):,} failures that the run lists come to the f recorded."
        )
        _print_trials(different)
    raise typer.Exit(3 if different else 0)


def _answer_trials(trials: Sequence[Trial], ego: str, seconds: float, as_json: bool) -> None:
    """Print trials of an ego and exit."""
    bad = [trial for trial in trials if trial.outcome != "passed"]
    if as_json:
        print_json({"ego": ego, **_describe_trials(trials, seconds)})
    else:
        errors = sum(trial.outcome == "error" for trial in trials)
        failed = f"fails in {len(bad) - errors:,} of {len(trials):,} scenarios"
        print(f"{ego} {failed}{f' and does not answer in {errors:,}' if errors else ''} ({seconds:.1f} s).")
        _print_trials(bad)
    raise typer.Exit(FAILS if bad else 0)


def _describe_trials(trials: Sequence[Trial], seconds: float) -> dict[str, Any]:
    outcomes = [trial.outcome for trial in trials]
    counts = {outcome: outcomes.count(outcome) for outcome in ("passed", "failed", "error")}
    return {**counts, "seconds": seconds, "trials": [trial.to_dict() for trial in trials]}


def _print_trials(trials: Sequence[Trial], most: int = 20) -> None:
    """Print a line for each trial, the first `most`."""
    from rare_envs.study.corpus import describe_trial

    for trial in trials[:most]:
        print(f"  {trial.failure.key}  {trial.failure.env_id}  {describe_trial(trial)}")
    if len(trials) > most:
        print(f"  and {len(trials) - most:,} more; --json has all.")


@use_one_thread()
def replay_command(
    context: typer.Context,
    run: RunArgument,
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
    """Replay a failure that a run has found, and show it with its measure over time."""
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
    with keep_stdout_for_the_answer(), contextlib.nullcontext() if out is None else output_file(out):
        recorded = find_failure(run, failure, trust, ego)
        drive = drive_again(recorded.problem, recorded.x)
        if out is not None:
            write_film(out, drive)
    same = abs(drive.f - recorded.f) <= REPLAY_TOLERANCE
    answer = {
        "failure": failure,
        "failures": recorded.n_listed,
        "n_failures": recorded.n_found,
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


@use_one_thread()
def export_command(
    run: RunArgument,
    out: Annotated[Path, typer.Option(help="The .xosc to write, its road beside it as .xodr; .xml for CommonRoad.")],
    failure: Annotated[int, typer.Option(help="Which failure; 0 is the most likely.")] = 0,
    format: Annotated[
        str, typer.Option(help="openscenario, carla (for scenario_runner) or commonroad.")
    ] = "openscenario",
    ego: Annotated[
        str | None,
        typer.Option(help="recorded: it follows its trajectory; free: it only has a start. carla leaves it free."),
    ] = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a failure as OpenSCENARIO and OpenDRIVE, for CARLA's scenario_runner, or as CommonRoad XML."""
    from rare_envs.study.export import check_export, export_scenario
    from rare_envs.study.video import find_failure

    with keep_stdout_for_the_answer(), as_bad_input(ValueError):
        check_export(out, format, ego)
        with output_file(out):
            recorded = find_failure(run, failure, trust)
            try:
                files = export_scenario(recorded.problem, recorded.x, out, format, ego)  # type: ignore[arg-type]
            except OSError as error:
                raise BadInput(f"Cannot write {str(out)!r}: {error.strerror or error}.") from error
    names = [str(path) for path in files]
    if as_json:
        print_json({"failure": failure, "failures": recorded.n_listed, "format": format, "files": names})
    else:
        print(f"Wrote {' and '.join(names)}.")
