"""Commands of the command line `rare-envs`: each reads its options, calls one function and prints.

Exit codes: 0 done, 2 bad input (one line on standard error), 3 done with warnings that make the number unreliable;
with a limit (--max-p, --max-rate, --max-ratio) 0 passes, 4 fails, 5 undecided.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Annotated

import typer
from typer import Argument, Option

from rare_envs.startup import __version__
from rare_envs.study.arguments import as_bad_input
from rare_envs.study.cli import egos_and_runs, estimate
from rare_envs.study.cli.options import PanelCommand, command
from rare_envs.study.cli.shell import Answer, OneLineErrors, end_soon

EXAMPLES = """
rare-envs list
rare-envs list CutIn
rare-envs list egos
rare-envs list bases
rare-envs train-ego CutIn --steps 200000 --out ppo.zip
rare-envs train-ego all --steps 400000 --out ppo.zip
rare-envs train-ego --from-failures runs/cutin --out better.zip
rare-envs check-ego ppo.zip CutIn
rare-envs check-ego tcp://127.0.0.1:5555 CutIn
rare-envs estimate CutIn --ego ppo.zip --out runs/cutin
rare-envs estimate CutIn --ego ppo.zip --max-rate 1 --workers 4
rare-envs estimate CarFollowing --base us101-gap --method mc --max-sim 1e5
rare-envs estimate CutIn --ego ppo.zip --plan --target-cov 0.1
rare-envs estimate runs/cutin --plan --target-cov 0.05
rare-envs estimate highway-fast-v0 --ego dqn.zip --max-sim 300
rare-envs risk ppo.zip --out runs/risk
rare-envs risk ppo.zip --scenario CutIn --max-rate 1 --workers 4
rare-envs risk idm --sites us101,i80
rare-envs compare old.zip new.zip CutIn --out runs/compared
rare-envs compare old.zip new.zip --max-ratio 1.2
rare-envs resume runs/cutin
rare-envs resume runs/risk --workers 4
rare-envs fit --highd path/to/highD/data --out bases --name cologne
rare-envs fit --tgsim path/to/tgsim --cut-gaps --scenario cut_in --out bases
rare-envs report runs/cutin --figures pdf
rare-envs replay runs/cutin --out crash.gif
rare-envs replay runs/cutin --mode 2
rare-envs replay runs/cutin --failure 3 --ego new.zip
rare-envs replay runs/cutin --all
rare-envs export runs/cutin crash.xosc
rare-envs export runs/cutin crash.xml --format commonroad
rare-envs export ppo.zip ppo.onnx
rare-envs corpus add runs/cutin --corpus corpus --limit 5
rare-envs corpus run --ego new.zip --corpus corpus --junit corpus.xml
"""
"""Examples of all commands, shown on their pages."""
FIRST = ("rare-envs list", "rare-envs estimate CutIn --ego idm --max-sim 3000")
"""Examples on the first page."""
WIDEST = 120
"""Most columns of a help page, which is as wide as the terminal."""

app = typer.Typer(
    cls=OneLineErrors,
    help="How often does a driving policy crash? Train one, estimate its rare failures, see the most likely.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"max_content_width": WIDEST},
)


def _print_version(wanted: bool) -> None:
    """Print the version and exit, if it is wanted."""
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
            metavar="[WHAT]",
            help="A scenario, such as CutIn, with its traffic models; or environments, bases, methods, egos, drivers, "
            "measures, weather or all.",
        ),
    ] = None,
) -> Answer:
    """List scenarios, traffic models, methods, egos, drivers and measures; with one of these words, what they mean."""
    from rare_envs.study.cli.listing import choose_entries, list_names, print_details, print_overview

    entries = list_names()
    if what is None:
        return Answer(entries, partial(print_overview, entries))
    with as_bad_input(ValueError):
        chosen = choose_entries(entries, what)
    return Answer(chosen, partial(print_details, chosen))


def list_examples(page: str) -> list[str]:
    """Return the examples on the help page of a command, or of a group of them."""
    return [line for line in EXAMPLES.split("\n") if f"{line} ".startswith(f"rare-envs {page} ")] if page else [*FIRST]


def format_examples(page: str) -> str:
    """Return the text below a help page, whose lines are not to be filled."""
    return "\n".join(("\b", "Examples:", *(f"  {line}" for line in list_examples(page))))


COMMANDS = (
    *("list", "train-ego", "check-ego", "estimate", "risk", "compare", "resume", "fit", "report", "replay", "export"),
    *("corpus add", "corpus run"),
)
"""Commands in the order of the first page; the function of `corpus add` is `corpus_add_command`."""
CORPUS = "Keep failures as regression scenarios, and test other egos in them."
corpus_app = typer.Typer(help=CORPUS, short_help=CORPUS, epilog=format_examples("corpus"))
app.add_typer(corpus_app, name="corpus")
app.info.epilog = format_examples("")
_functions = {**vars(estimate), **vars(egos_and_runs), **globals()}
for _name in COMMANDS:
    _group, _, _word = _name.rpartition(" ")
    _function = _functions[f"{_name.replace(' ', '_').replace('-', '_')}_command"]
    _summary = f"{(_function.__doc__ or '').partition('. ')[0].rstrip('.')}."  # whole, where Typer would cut it
    _register = (corpus_app if _group else app).command
    _register(_word, cls=PanelCommand, short_help=_summary, epilog=format_examples(_name))(_function)


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
