"""Command `export`: a failure of a run as files that other simulators open."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rare_envs.study.cli.options import JsonOption, TrustOption
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, as_bad_input, output_file
from rare_envs.threads import use_one_thread


@use_one_thread()
def export_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")],
    out: Annotated[Path, typer.Option(help="The .xosc to write, its road beside it as .xodr; .xml for CommonRoad.")],
    failure: Annotated[int, typer.Option(help="Which failure; 0 is the most likely.")] = 0,
    format: Annotated[
        str,
        typer.Option(
            help="openscenario, carla (for scenario_runner) or commonroad.",
        ),
    ] = "openscenario",
    ego: Annotated[
        str | None,
        typer.Option(
            help="recorded: it follows its trajectory; free: it only has a start. carla leaves it free.",
        ),
    ] = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a failure as OpenSCENARIO and OpenDRIVE, for CARLA's scenario_runner, or as CommonRoad XML."""
    from rare_envs.study.export import export_scenario
    from rare_envs.study.export.writing import check_export
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
