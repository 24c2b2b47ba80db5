"""Commands `reproduce`: tables and figures of published papers, made anew and set beside those that were printed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rare_envs.study.cli.executor_options import ExecutorOptions
from rare_envs.study.cli.options import JsonOption, read_count
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.threads import use_one_thread
from training.command_line import spread_options

reproduce_app = typer.Typer(help="Make the tables and figures of a published paper anew.")


@reproduce_app.callback()
def reproduce_command() -> None:
    """Make the tables and figures of a published paper anew."""


@reproduce_app.command("okelly2018")
@spread_options
@use_one_thread()
def reproduce_okelly2018_command(
    places: ExecutorOptions,
    out: Annotated[Path, typer.Option(help="Folder of rollouts, record and page; goes on with those there.")],
    scale: Annotated[str, typer.Option(help="small, or full: the paper's, for days.")] = "small",
    ego: Annotated[str, typer.Option(help="lidar (Table 1, Figure 2) or vision (Table 2, Figure 3).")] = "lidar",
    seed: Annotated[int, typer.Option(help="Of all draws.")] = 2018,
    at_most: Annotated[
        int | None,
        typer.Option(help="Rollouts to make now; the page says what is not run.", parser=read_count, metavar="INTEGER"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """O'Kelly et al. 2018: naive Monte Carlo against cross-entropy on the highway, and what failures look like."""
    from rare_envs.study.reproduction.okelly2018.reproduction import reproduce_okelly2018
    from rare_envs.study.reproduction.okelly2018.study import HighwayStudy

    if at_most is not None and at_most < 0:
        raise BadInput(f"Expected --at-most to be 0 or more, got {at_most}.")
    with keep_stdout_for_the_answer():
        with as_bad_input(ValueError):
            study, executor = HighwayStudy(ego, scale, seed), places.make()
        command = f"rare-envs reproduce okelly2018 --scale {scale} --ego {ego} --seed {seed}"
        record = reproduce_okelly2018(study, out, command, executor, at_most, progress=True)
    if as_json:
        print_json(record)
        return
    for note in record["notes"]:
        print(note)
    for found in record["findings"]:
        print(f"{found['claim']}: {found['verdict']}. {found['statistic']}.")
    print(f"Wrote {out / 'reproduction.html'}.")
