"""Commands of the command line `rare-envs`: each reads its options, calls one function and prints.

Exit codes: 0 done, 2 bad input (one line on standard error), 3 done with warnings that make the number doubtful; with
--max-p or --max-rate 0 passes, 4 fails, 5 undecided.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Annotated

import typer
from typer import Argument, Option

from rare_envs.startup import __version__
from rare_envs.study.arguments import as_bad_input
from rare_envs.study.cli import egos, estimate, runs
from rare_envs.study.cli.shell import Answer, OneLineErrors, SummarisedCommands, command, end_soon

EXAMPLES = """
rare-envs list
rare-envs list egos
rare-envs list CutIn-v0
rare-envs estimate rare_envs/CutIn-v0 --ego ppo.zip --out runs/cutin
rare-envs estimate rare_envs/CarFollowing-v0 --base us101-gap --method mc --max-sim 1e5
rare-envs estimate highway-fast-v0 --ego dqn.zip --max-sim 300
rare-envs resume runs/cutin
rare-envs resume runs/cutin --workers 4
rare-envs risk ppo.zip --out runs/risk
rare-envs risk idm --sites us101,i80
rare-envs bases cut_in
rare-envs bases rare_envs/HardBrake-v0 --json
rare-envs compare old.zip new.zip rare_envs/CutIn-v0 --out runs/compared
rare-envs plan rare_envs/CutIn-v0 --ego ppo.zip --cov 0.1
rare-envs plan runs/cutin --cov 0.05
rare-envs replay runs/cutin --out crash.gif
rare-envs replay runs/cutin --failure 3 --ego new.zip
rare-envs replay runs/cutin --all
rare-envs report runs/cutin --figures pdf
rare-envs export runs/cutin --out crash.xosc
rare-envs export runs/cutin --out crash.xml --format commonroad
rare-envs fit --highd path/to/highD/data --out bases --name cologne
rare-envs fit --tgsim path/to/tgsim --cut-gaps --scenario cut_in --out bases
rare-envs train-ego rare_envs/CutIn-v0 --steps 200000 --out ppo.zip
rare-envs train-ego all --steps 400000 --out ppo.zip
rare-envs train-ego rare_envs/CutIn-v0 --algo dqn --out dqn.zip
rare-envs train-drivers --highd path/to/highD/data --out runs/drivers --method gail
rare-envs check-ego ppo.zip rare_envs/CutIn-v0
rare-envs check-ego tcp://127.0.0.1:5555 rare_envs/CutIn-v0
rare-envs serve-ego ppo.zip --bind tcp://127.0.0.1:5555
rare-envs export-ego ppo.zip ppo.onnx
rare-envs corpus add runs/cutin --corpus corpus --most 5
rare-envs corpus run --ego new.zip --corpus corpus --junit corpus.xml
"""
"""Examples of all commands, shown on their pages."""
FIRST = ("rare-envs list", "rare-envs estimate rare_envs/CutIn-v0 --ego idm --max-sim 3000")
"""Examples on the first page."""

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
        bool, Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """How often does a driving policy crash? Train one, estimate its rare failures, see the most likely."""


@command()
def list_command(
    what: Annotated[
        str | None,
        Argument(
            metavar="[WHAT]", help="environments, methods, egos, drivers, measures, weather, all, or an environment."
        ),
    ] = None,
) -> Answer:
    """Show the names of environments, methods, egos, drivers and measures; with one of these words, what they mean."""
    from rare_envs.study.cli.listing import choose_entries, list_names, print_details, print_overview

    entries = list_names()
    if what is None:
        return Answer(entries, partial(print_overview, entries))
    chosen = choose_entries(entries, what)
    return Answer(chosen, partial(print_details, chosen))


@command()
def bases_command(
    scenario: Annotated[str, Argument(metavar="SCENARIO", help="Environment, or its short name: cut_in.")],
) -> Answer:
    """List the base distributions of a scenario: events, site, family, fit, frequency and predictive checks."""
    from rare_envs.study.cli.listing import list_bases, print_bases

    with as_bad_input(ValueError):
        env_id, found = list_bases(scenario)
    data = {"scenario": scenario, "env_id": env_id, "bases": found}
    return Answer(data, partial(print_bases, env_id, found))


def list_examples(page: str) -> list[str]:
    """Return the examples on the help page of a command, or of a group of them."""
    return [line for line in EXAMPLES.split("\n") if f"{line} ".startswith(f"rare-envs {page} ")] if page else [*FIRST]


def format_examples(page: str) -> str:
    """Return the text below a help page, whose lines are not to be filled."""
    return "\n".join(("\b", "Examples:", *(f"  {line}" for line in list_examples(page))))


COMMANDS = (
    *("list", "estimate", "risk", "bases", "resume", "compare", "fit", "train-ego", "train-drivers", "export-ego"),
    *("replay", "export", "plan", "report", "check-ego", "serve-ego", "corpus add", "corpus run"),
)
"""Commands in the order of the first page; the function of `corpus add` is `corpus_add_command`."""
corpus_app = typer.Typer(
    cls=SummarisedCommands,
    help="Keep failures as regression scenarios, and try other egos in them.",
    epilog=format_examples("corpus"),
)
app.add_typer(corpus_app, name="corpus")
app.info.epilog = format_examples("")
_functions = {**vars(estimate), **vars(egos), **vars(runs), **globals()}
for _name in COMMANDS:
    _group, _, _word = _name.rpartition(" ")
    _function = _functions[f"{_name.replace(' ', '_').replace('-', '_')}_command"]
    (corpus_app if _group else app).command(_word, epilog=format_examples(_name))(_function)


def main() -> None:
    """Run the command line; alone, it shows its help."""
    code: object = 1
    try:
        app(sys.argv[1:] or ["--help"], prog_name="rare-envs")
    except SystemExit as end:
        code = end.code or 0
        raise
    finally:
        end_soon(code if isinstance(code, int) else 1)


if __name__ == "__main__":
    main()
