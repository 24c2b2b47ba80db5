"""Commands `corpus add` and `corpus run`, and the replay of all failures of a run."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rare_envs.study.cli.options import (
    ActionOption,
    AlgoOption,
    JsonOption,
    ObservationOption,
    StatsOption,
    TrustOption,
)
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, output_file
from rare_envs.threads import use_one_thread

if TYPE_CHECKING:
    from rare_envs.study.corpus.trial import Trial

FAILS = 4
"""Exit code where the ego fails in a stored scenario, as where p is above a limit."""
CorpusOption = Annotated[Path, typer.Option(help="Folder of the corpus.")]

corpus_app = typer.Typer(help="Keep failures as regression scenarios, and try other egos in them.")


@corpus_app.command("add")
def corpus_add_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")],
    corpus: CorpusOption = Path("corpus"),
    most: Annotated[int, typer.Option(help="Failures to add: the most likely, and one of each kind of crash.")] = 20,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Add the failures of a run to a corpus, a file each, named by what is in it."""
    from rare_envs.study.corpus.storage import add_run

    with keep_stdout_for_the_answer():
        chosen, new = add_run(run, corpus, most, trust)
    if as_json:
        print_json({"corpus": str(corpus), "added": new, "failures": [each.key for each in chosen]})
    else:
        print(f"Added {new} of {len(chosen)} failures to {corpus}{'' if new else '; it had all of them'}.")


@corpus_app.command("run")
@use_one_thread()
def corpus_run_command(
    ego: Annotated[str, typer.Option(help="The ego to try, as for estimate --ego.")],
    corpus: CorpusOption = Path("corpus"),
    junit: Annotated[Path | None, typer.Option(help="File for a JUnit report.")] = None,
    algo: AlgoOption = None,
    stats: StatsOption = None,
    observation: ObservationOption = None,
    action: ActionOption = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Try an ego in all scenarios of a corpus. Exit code 0: it fails in none; 4: it does."""
    from rare_envs.study.corpus.junit import write_junit
    from rare_envs.study.corpus.storage import read_corpus
    from rare_envs.study.corpus.trial import EgoChoice, try_ego

    choice = EgoChoice(ego=ego, algo=algo, stats=stats, observation=observation, action=action)
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
    from rare_envs.study.corpus.storage import read_run
    from rare_envs.study.corpus.trial import EgoChoice, repeat_run, try_ego

    with keep_stdout_for_the_answer():
        failures = read_run(run, trust)
        if not failures:
            raise BadInput(f"The run in {str(run)!r} has no failure.")
        trials, seconds = (
            repeat_run(run, failures, trust) if ego is None else try_ego(failures, EgoChoice(ego=ego), run, trust)
        )
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
    from rare_envs.study.corpus.junit import describe_trial

    for trial in trials[:most]:
        print(f"  {trial.failure.key}  {trial.failure.env_id}  {describe_trial(trial)}")
    if len(trials) > most:
        print(f"  and {len(trials) - most:,} more; --json has all.")
