"""Commands about a finished run: `report`, `replay`, `export` and `corpus`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from rare_envs.study.arguments import BadInput, as_bad_input, output_file, output_folder, refuse_existing
from rare_envs.study.cli.shell import DOUBTFUL, EGO_FILE, Answer, ForceOption, RunArgument, command

if TYPE_CHECKING:
    from rare_envs.study.corpus import Trial

FAILS = 4
"""Exit code where the ego fails in a stored scenario, as where p is above a limit."""
MOST_SHOWN = 20
"""Trials that have a line."""
CorpusOption = Annotated[Path, Option(help="Folder of the corpus.")]
FailureOption = Annotated[int, Option(help="Which failure; 0 is the most likely.")]


@command("trust")
def report_command(
    run: RunArgument,
    asked: dict[str, Any],
    out: Annotated[Path | None, Option(help="The .html file; report.html in RUN by default.")] = None,
    events: Annotated[
        Path | None,
        Option(help="CSV of recorded events, with columns named as the parameters: how near they come."),
    ] = None,
    figures: Annotated[str | None, Option(help="Figures as files too, beside the page: svg, pdf or png.")] = None,
    force: ForceOption = False,
) -> Answer:
    """Write the report of a run as one HTML file, with its failures by mode, driven again and filmed."""
    from rare_envs.study.html_report import write_html_report

    refuse_existing(force, out, out and out.parent / "figures" if figures else None)
    page, *drawn = write_html_report(run, events=events, out=out, figures=figures, **asked)
    text = f"Wrote {page}{f' and {len(drawn)} figures' if drawn else ''}."
    return Answer({"report": str(page), "figures": [str(path) for path in drawn]}, text)


@command("trust")
def corpus_add_command(
    run: RunArgument,
    asked: dict[str, Any],
    typed: set[str],
    corpus: CorpusOption = Path("corpus"),
    most: Annotated[int, Option(help="Failures to add: the most likely, and one of each kind of crash.")] = 20,
) -> Answer:
    """Add the failures of a run to a corpus, a file each, named by what is in it."""
    from rare_envs.study.corpus import add_run

    # the working directory may be somebody else's
    with output_folder(corpus.parent, folders=() if "corpus" in typed else (corpus.name,)):
        chosen, new = add_run(run, corpus, most, **asked)
    text = f"Added {new} of {len(chosen)} failures to {corpus}{'' if new else '; it had all of them'}."
    return Answer({"corpus": str(corpus), "added": new, "failures": [each.key for each in chosen]}, text)


@command(*EGO_FILE, "observation", "action", "trust")
def corpus_run_command(
    ego: Annotated[str, Option(help="The ego to try, as for estimate --ego.")],
    asked: dict[str, Any],
    corpus: CorpusOption = Path("corpus"),
    junit: Annotated[Path | None, Option(help="File for a JUnit report.")] = None,
    force: ForceOption = False,
) -> Answer:
    """Try an ego in all scenarios of a corpus. Exit code 0: it fails in none; 4: it does."""
    from rare_envs.study.corpus import read_corpus, try_ego, write_junit

    with output_file(junit, force or _is_junit(junit)):
        trials, seconds = try_ego(read_corpus(corpus), corpus, ego, **asked)
        if junit is not None:
            with _unwritten(junit):
                write_junit(junit, trials, ego, seconds)
    return _describe_tries(trials, seconds, ego)


def _is_junit(path: Path | None) -> bool:
    """Return whether a file is a JUnit report, which the next one replaces, as those of other tools do."""
    if path is None or not path.is_file():
        return False
    with path.open("rb") as file:
        return b"<testsuites" in file.read(100)


def replay_all(folder: Path, ego: str | None, trust: bool) -> Answer:
    """Simulate all failures that a run has recorded again, with its ego or another."""
    from rare_envs.study.corpus import list_failures, try_ego, try_world
    from rare_envs.study.question import open_run, prepare
    from rare_envs.study.run_folder import load_finished

    start, run = time.perf_counter(), load_finished(folder)
    failures = list_failures(run, trust, **({} if ego is None else {"ego": ego}))
    if not failures:
        raise BadInput(f"The run in {str(folder)!r} has no failure.")
    if ego is not None:
        return _describe_tries(*try_ego(failures, None, ego, trust=trust), ego)
    with as_bad_input(ValueError, OSError):
        trials = try_world(prepare(open_run(run, trust)).problem, failures)
    different = [trial for trial in trials if not trial.same]
    same = len(trials) - len(different)
    lines = [f"{same:,} of {len(trials):,} failures that the run lists come to the f recorded.", *_list(different)]
    data = _count(trials, time.perf_counter() - start) | {"same": same}
    return Answer(data, "\n".join(lines), DOUBTFUL if different else 0)


def _describe_tries(trials: Sequence[Trial], seconds: float, ego: str) -> Answer:
    """Return the answer of trials of an ego."""
    bad = [trial for trial in trials if trial.outcome != "passed"]
    errors = sum(trial.outcome == "error" for trial in trials)
    failed = f"fails in {len(bad) - errors:,} of {len(trials):,} scenarios"
    first = f"{ego} {failed}{f' and does not answer in {errors:,}' if errors else ''} ({seconds:.1f} s)."
    return Answer({"ego": ego, **_count(trials, seconds)}, "\n".join([first, *_list(bad)]), FAILS if bad else 0)


def _count(trials: Sequence[Trial], seconds: float) -> dict[str, Any]:
    """Return trials and their outcomes, JSON-ready."""
    outcomes = [trial.outcome for trial in trials]
    counts = {outcome: outcomes.count(outcome) for outcome in ("passed", "failed", "error")}
    return {**counts, "seconds": seconds, "trials": [trial.to_dict() for trial in trials]}


def _list(trials: Sequence[Trial]) -> list[str]:
    """Return a line for each trial, the first `MOST_SHOWN`."""
    lines = [f"  {each.failure.key}  {each.failure.env_id}  {each.describe()}" for each in trials[:MOST_SHOWN]]
    rest = len(trials) - MOST_SHOWN
    return lines if rest <= 0 else [*lines, f"  and {rest:,} more; --json has all."]


@command("trust")
def replay_command(
    run: RunArgument,
    asked: dict[str, Any],
    typed: set[str],
    failure: FailureOption = 0,
    out: Annotated[Path | None, Option(help="A .gif of the drive, or a .png of its worst moment.")] = None,
    ego: Annotated[str | None, Option(help="Another ego, as for estimate --ego, in the place of the run's.")] = None,
    replay_each: Annotated[
        bool, Option("--all", help="Simulate all failures again and compare their f; without a film.")
    ] = False,
    force: ForceOption = False,
) -> Answer:
    """Replay a failure that a run has found, and show it with its measure over time."""
    from rare_envs.study.plots import check_film_path, write_film
    from rare_envs.study.replay import REPLAY_TOLERANCE, describe_drive, drive_again, find_failure

    if replay_each:
        if out is not None:
            raise BadInput("Expected --all without --out: a film shows one failure.")
        if "failure" in typed:
            raise BadInput("Expected --all without --failure: it simulates all of them.")
        return replay_all(run, ego, **asked)
    if out is not None:
        check_film_path(out)
    with output_file(out, force):
        recorded = find_failure(run, failure, asked["trust"], ego)
        drive = drive_again(recorded.problem, recorded.x)
        if out is not None:
            write_film(out, drive)
    same = abs(drive.f - recorded.f) <= REPLAY_TOLERANCE
    data = {
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
    lines = [*describe_drive(recorded, drive, failure, ego), *([] if out is None else [f"Wrote {out}."])]
    return Answer(data, "\n".join(lines), 0 if same or ego is not None else DOUBTFUL)


@command("trust")
def export_command(
    run: RunArgument,
    asked: dict[str, Any],
    out: Annotated[Path, Option(help="The .xosc to write, its road beside it as .xodr; .xml for CommonRoad.")],
    failure: FailureOption = 0,
    format: Annotated[str, Option(help="openscenario, carla (for scenario_runner) or commonroad.")] = "openscenario",
    ego: Annotated[
        str | None,
        Option(help="recorded: it follows its trajectory; free: it only has a start. carla leaves it free."),
    ] = None,
    force: ForceOption = False,
) -> Answer:
    """Write a failure as OpenSCENARIO and OpenDRIVE, for CARLA's scenario_runner, or as CommonRoad XML."""
    from rare_envs.study.export import check_export, export_scenario
    from rare_envs.study.replay import find_failure

    with as_bad_input(ValueError):
        check_export(out, format, ego)
        refuse_existing(force or format == "commonroad", out.with_suffix(".xodr"))
        with output_file(out, force):
            recorded = find_failure(run, failure, **asked)
            with _unwritten(out):
                files = export_scenario(recorded.problem, recorded.x, out, format, ego)  # type: ignore[arg-type]
    names = [str(path) for path in files]
    data = {"failure": failure, "failures": recorded.n_listed, "format": format, "files": names}
    return Answer(data, f"Wrote {' and '.join(names)}.")


@contextlib.contextmanager
def _unwritten(path: Path) -> Iterator[None]:
    """Say which file cannot be written."""
    try:
        yield
    except OSError as error:
        raise BadInput(f"Cannot write {str(path)!r}: {error.strerror or error}.") from error
