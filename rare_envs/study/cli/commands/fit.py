"""Command `fit`: base distributions fitted to recorded traffic."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rare_envs.study.cli.options import JsonOption
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import as_bad_input
from rare_envs.threads import use_one_thread
from training.command_line import EventOptions, spread_options


@spread_options
@use_one_thread()
def fit_command(
    out: Annotated[Path, typer.Option(help="Folder for the JSON files.")],
    recordings: EventOptions,
    cut_gaps: Annotated[bool, typer.Option("--cut-gaps", help="Cut tracks where frames are missing.")] = False,
    scenario: Annotated[
        list[str] | None, typer.Option(help="Which to fit, may be repeated; all that have enough events by default.")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the bases of your own recordings.")] = "own",
    refits: Annotated[int | None, typer.Option(help="Refits: 30, or 100 where their components differ.", min=2)] = None,
    seed: Annotated[int, typer.Option(help="Seed of the fits.", min=0)] = 0,
    as_json: JsonOption = False,
) -> None:
    """Fit base distributions to recorded traffic, with refits that say how far the events determine them."""
    from training.scenario_fitting.fit import fit_bases

    with keep_stdout_for_the_answer(), as_bad_input(ValueError, OSError):
        files = fit_bases(
            recordings,
            out,
            cut_gaps=cut_gaps,
            scenarios=scenario,
            name=name,
            n_refits=refits,
            seed=seed,
            progress=True,
        )
    if as_json:
        print_json({"bases": [str(path) for path in files]})
    else:
        print("\n".join(f"{path}: rare-envs estimate ENV --base {path}" for path in files))
