"""Commands `reproduce`: tables and figures of published papers, made anew and set beside those that were printed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
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


class ScaleChoice(str, Enum):
    """Size of a reproduction."""

    SMALL = "small"
    FULL = "full"


ReproductionFolder = Annotated[Path, typer.Option("--out", help="Folder of runs, JSON and page, of one reproduction.")]
ScaleOption = Annotated[ScaleChoice, typer.Option(help="small: minutes; full: as many runs as the paper has.")]
ReplicationsOption = Annotated[
    int | None, typer.Option("--replications", min=2, help="Replications of every method, instead of the scale's.")
]
ResumeOption = Annotated[
    bool, typer.Option("--resume/--afresh", help="Go on with the runs in the folder, or delete them and make all anew.")
]
WorkersOption = Annotated[int, typer.Option(min=1, help="Processes.")]
FirstSeedOption = Annotated[int, typer.Option("--seed", min=0, help="Seed of the first replication.")]


@reproduce_app.callback()
def reproduce_command() -> None:
    """Make the tables and figures of a published paper anew."""


@contextmanager
def say_how_to_go_on(folder: Path) -> Iterator[None]:
    """Say where the runs are, and what goes on with them, if an interruption stops them."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"The runs so far are in {folder}; the same command goes on with them.", err=True)
        raise


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
    with keep_stdout_for_the_answer(), say_how_to_go_on(out):
        with as_bad_input(ValueError):
            study, executor = HighwayStudy(ego, scale, seed), places.make()
        command = f"rare-envs reproduce okelly2018 --scale {scale} --ego {ego} --seed {seed} --out FOLDER"
        record = reproduce_okelly2018(study, out, command, executor, at_most, progress=True)
    if as_json:
        print_json(record)
        return
    for note in record["notes"]:
        print(note)
    speed = record["runs"][0]["rollouts_per_second"]
    if speed is not None:
        print(f"Fastest chunk of this run: {speed:,.3g} rollouts a second, wall time.")
    for found in record["findings"]:
        print(f"{found['claim']}: {found['verdict']}. {found['statistic']}.")
    print(f"Wrote {out / 'reproduction.html'}.")


@reproduce_app.command("tian2024")
@use_one_thread()
def reproduce_tian2024_command(
    out: ReproductionFolder = Path("tian2024"),
    scale: ScaleOption = ScaleChoice.FULL,
    replications: ReplicationsOption = None,
    monte_carlo: Annotated[
        int | None,
        typer.Option("--monte-carlo-replications", help="Of Monte Carlo, which takes most of the time."),
    ] = None,
    further: Annotated[
        int | None,
        typer.Option("--further-replications", help="Of the methods that the paper does not have."),
    ] = None,
    seed: FirstSeedOption = 0,
    workers: WorkersOption = 1,
    resume: ResumeOption = True,
    as_json: JsonOption = False,
) -> None:
    """Tian et al. 2024: Tables II and III, Figures 6 to 8. Writes reproduction.html and reproduction.json."""
    from rare_envs.study.reproduction.folder import discard_runs
    from rare_envs.study.reproduction.tian2024.study import REPLICATIONS_FILE, SCALES, TianPlan, reproduce_tian2024

    number = SCALES[scale.value] if replications is None else replications
    fewer = "" if monte_carlo is None else f" --monte-carlo-replications {monte_carlo}"
    fewer += "" if further is None else f" --further-replications {further}"
    command = f"rare-envs reproduce tian2024 --replications {number}{fewer} --seed {seed}"
    with keep_stdout_for_the_answer(), say_how_to_go_on(out), as_bad_input(ValueError, OSError):
        plan = TianPlan(replications=number, seed=seed, monte_carlo=monte_carlo, further=further)
        if not resume:
            discard_runs(out / REPLICATIONS_FILE, "tian2024")
        record = reproduce_tian2024(plan, out, command, workers, progress=True)
    if as_json:
        print_json(record)
        return
    for finding in record["findings"]:
        print(f"{finding['claim']}: {finding['verdict']}")
    print(f"Wrote {out / 'reproduction.html'} and {out / 'reproduction.json'}.")
