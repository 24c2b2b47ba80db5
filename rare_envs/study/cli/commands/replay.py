"""Command `replay`: a failure that a run has found, driven again and shown."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from rare_envs.study.cli.commands.corpus import replay_all
from rare_envs.study.cli.options import JsonOption, TrustOption
from rare_envs.study.cli.shell import DOUBTFUL, is_typed, keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, output_file
from rare_envs.threads import use_one_thread


@use_one_thread()
def replay_command(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")],
    failure: Annotated[int, typer.Option(help="Which failure; 0 is the most likely.")] = 0,
    out: Annotated[Path | None, typer.Option(help="A .gif of the drive, or a .png of its worst moment.")] = None,
    ego: Annotated[
        str | None,
        typer.Option(
            help="Another ego, as for estimate --ego, in the place of the run's.",
        ),
    ] = None,
    replay_each: Annotated[
        bool, typer.Option("--all", help="Simulate all failures again and compare their f; without a film.")
    ] = False,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Replay a failure that a run has found, and show it with its measure over time."""
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
    with keep_stdout_for_the_answer(), contextlib.nullcontext() if out is None else output_file(out):
        recorded = find_failure(run, failure, trust) if ego is None else find_for_ego(run, failure, ego, trust)
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
