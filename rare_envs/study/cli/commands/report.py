"""Command `rare-envs report`: the report of a run as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rare_envs.study.cli.options import JsonOption, TrustOption
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.threads import use_one_thread


@use_one_thread()
def report_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")],
    out: Annotated[Path | None, typer.Option(help="The .html file; report.html in RUN by default.")] = None,
    events: Annotated[
        Path | None,
        typer.Option(help="CSV of recorded events, with columns named as the parameters: how near they come."),
    ] = None,
    figures: Annotated[
        str | None,
        typer.Option(
            help="Figures as files too, beside the page: svg, pdf or png.",
        ),
    ] = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the report of a run as one HTML file, with its failures by mode, driven again and filmed."""
    from rare_envs.study.html_report.page import write_html_report

    with keep_stdout_for_the_answer():
        written = write_html_report(run, trust, events, out, figures)
    if as_json:
        print_json({"report": str(written[0]), "figures": [str(path) for path in written[1:]]})
    else:
        print(f"Wrote {written[0]}{f' and {len(written) - 1} figures' if written[1:] else ''}.")
