"""Commands about egos, recordings and finished runs: `train-ego`, `check-ego`, `fit`, `report` to `corpus`."""

from __future__ import annotations

import json
import shlex
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from rare_envs.scenarios.registry import SCENARIOS, find_scenario
from rare_envs.study.arguments import BadInput, Question, as_bad_input, output_file, output_folder, refuse_existing
from rare_envs.study.cli import options
from rare_envs.study.cli.options import EGO_FILE, ForceOption, RunArgument, command
from rare_envs.study.cli.shell import DOUBTFUL, NOISE, Answer, read_count
from training.command_line import EventOptions, spread_options

if TYPE_CHECKING:
    from rare_envs.study.corpus import Trial

FAILS = 4
"""Exit code if the ego fails in a stored scenario, as if p is above a limit."""
MOST_SHOWN = 20
"""Trials that have a line."""
CorpusOption = Annotated[Path, Option(help="Folder of the corpus.")]
FailureOption = Annotated[int, Option(help="Number of the failure; 0 is the most likely.")]
ModeOption = Annotated[
    int | None, Option(help="Number of a kind of crash, 1 is the most frequent: its most likely failure.", min=1)
]
USUAL = {"noise": "on", "observation": "features", "action": "continuous"}
"""Options of `estimate` that need not be typed for an ego that is trained here."""


@command(*options.SCENARIO, "seed", "trust", more=("horizon", "noise", "weather"))
def train_ego_command(
    asked: dict[str, Any],
    envs: Annotated[
        list[str] | None,
        Argument(
            metavar="SCENARIO",
            help="Scenarios to train in, such as CutIn HardBrake, or all: those of rare-envs risk.",
        ),
    ] = None,
    algo: Annotated[str | None, Option(help="Algorithm of Stable-Baselines3.", show_default="ppo")] = None,
    steps: Annotated[
        int, Option(help="Environment steps to train for.", parser=read_count, metavar="INTEGER")
    ] = 200_000,
    out: Annotated[Path, Option(help="File to save the policy in.")] = Path("ego.zip"),
    num_envs: Annotated[int | None, Option(help="Parallel episodes; by default 320 with ppo, else 256.")] = None,
    device: Annotated[str, Option(help="Device that simulates and trains: cpu, or a GPU (cuda, cuda:1).")] = "cpu",
    resume: Annotated[bool, Option("--resume", help="Continue an interrupted training.")] = False,
    force: ForceOption = False,
    from_failures: Annotated[
        list[Path] | None,
        Option(
            metavar="RUN",
            help="Continue the training of the ego of this run, with its failures among ordinary scenarios; may be "
            "repeated: the ego of the last run, with the failures of all.",
        ),
    ] = None,
    failure_share: Annotated[float, Option(help="Share of episodes that start in such a failure.")] = 0.25,
    even_strata: Annotated[
        bool,
        Option(
            "--even-strata/--shares",
            help="Draw the kinds of an event equally often, or as often as they happen (in CutIn-v1 one cutter in "
            "6,000 does not look).",
        ),
    ] = True,
) -> Answer:
    """Train a policy in one or several scenarios, and save it for estimate --ego and risk."""
    from rare_envs.scenarios.registry import complete_id
    from rare_envs.study.risk import SCENARIO_SET
    from training import train_ego
    from training.ego_training import HYPERPARAMETERS

    seed, trust = asked.pop("seed"), asked.pop("trust")
    ids = tuple(map(complete_id, SCENARIO_SET if envs == ["all"] else envs or ()))
    more: dict[str, Any] = {"even_strata": even_strata}
    data, next_seed = dict[str, Any](), None
    if from_failures:
        from rare_envs.study.corpus import plan_retraining

        if any(value != getattr(Question, name) for name, value in asked.items()):
            raise BadInput("The world of --from-failures is that of the run: leave --base, --drivers and the like out.")
        plan = plan_retraining(from_failures, failure_share, trust)
        for name, given, own in (("SCENARIO", " ".join(ids), plan.env_id), ("--algo", algo, plan.algo)):
            if given not in ("", None, own):
                run = repr(str(from_failures[-1]))
                raise BadInput(f"Expected {name} {own}, that of the run in {run}, got {given!r}; leave it out.")
        ids, algo, world, next_seed = (plan.env_id,), plan.algo, dict(plan.world), plan.next_seed
        more["retraining"] = retraining = plan.retraining
        data = {"retrained": str(retraining.ego), "failures": len(retraining.failures)}
        data["failure_share"] = retraining.share
    elif not ids:
        raise BadInput("Expected a scenario, such as CutIn, or --from-failures RUN; rare-envs list has all.")
    else:
        algo = algo or "ppo"
        world = {**asked, **{name: asked[name] or USUAL[name] for name in ("observation", "action")}}
    more |= {} if device == "cpu" else {"device": device}
    world |= {"trust": True} if trust else {}
    with as_bad_input(ValueError, OSError):
        path = train_ego(ids, algo, steps, seed, num_envs, out, resume=resume, force=force, **more, **world)
    of_run = {"ego": str(path), "env_id": ids[0] if len(ids) == 1 else ids, "algo": algo, "steps": steps, "seed": seed}
    world.pop("trust", None)
    data = {**of_run, **world, "even_strata": even_strata, **data}
    if HYPERPARAMETERS[algo].discrete and asked["action"] is None:
        world["action"] = "discrete"  # which is what the algorithm made of it
    return Answer(data, f"Saved {path}. Next: {_advise_next(ids, str(path), world, next_seed)}")


def _advise_next(ids: Sequence[str], ego: str, world: Mapping[str, Any], seed: int | None) -> str:
    """Return the command that comes next, the estimate or the risk of several scenarios, and what its file says."""
    words = ["rare-envs", "estimate", *ids, "--ego", ego] if len(ids) == 1 else ["rare-envs", "risk", ego]
    named = [name for name in options.SCENARIO if world[name] not in (None, USUAL.get(name))]
    words += [word for name in named for word in (f"--{name}", str(world[name]))]
    words += ["--seed", str(seed)] if seed is not None and len(ids) == 1 else []
    noise = next(word for word, argument in NOISE.items() if argument == world["noise"])
    values = {"horizon": world["horizon"], "noise": noise, "weather": "true" if world["weather"] else None}
    lines = [f"{name}: {value}" for name, value in values.items() if value not in (None, USUAL.get(name))]
    return shlex.join(words) + (f" --config FILE, with {', '.join(lines)} in the file" if lines else "")


@spread_options
@command()
def fit_command(
    out: Annotated[Path, Option(help="Folder for the JSON files.")],
    recordings: EventOptions,
    cut_gaps: Annotated[bool, Option("--cut-gaps", help="Cut tracks at missing frames.")] = False,
    scenario: Annotated[
        list[str] | None,
        Option(help="Scenarios to fit, joined by commas; by default all that have enough events."),
    ] = None,
    name: Annotated[str, Option(help="Name of the traffic models of your recordings.")] = "own",
    refits: Annotated[
        int | None, Option(help="Number of bootstrap refits; by default 30, or 100 if their components differ.", min=2)
    ] = None,
    seed: Annotated[int, Option(help="Random seed of the fits.", min=0)] = 0,
    force: ForceOption = False,
) -> Answer:
    """Fit traffic models to recorded traffic, with bootstrap refits for their uncertainty."""
    from training.fit.recordings import fit_bases

    scenarios = options.split_words(scenario) or None
    settings: dict[str, Any] = {"scenarios": scenarios, "name": name, "n_refits": refits, "seed": seed, "force": force}
    with output_folder(out), as_bad_input(ValueError, OSError):
        files = fit_bases(recordings, out, cut_gaps=cut_gaps, progress=True, **settings)
    lines = [f"{path}: rare-envs estimate {_name_scenario(path)} --base {path}" for path in files]
    return Answer({"bases": [str(path) for path in files]}, "\n".join(lines))


def _name_scenario(path: Path) -> str:
    """Return the id of the scenario whose parameters a traffic model has, as it is typed."""
    names = json.loads(path.read_text(encoding="utf-8"))["names"]
    same = (each for each in SCENARIOS if [p.name for p in find_scenario(each).parameters] == names)
    return next(same, "SCENARIO").removeprefix("rare_envs/")


@command(*options.SCENARIO, *EGO_FILE, "trust")
def check_ego_command(
    ego: options.EgoArgument,
    env: options.EnvArgument,
    asked: dict[str, Any],
    time_limit: Annotated[float, Option(help="Time limit of each check in seconds.")] = 30.0,
    show_all: Annotated[bool, Option("--all", help="Show the checks that passed too, one per row.")] = False,
) -> Answer:
    """Check in seconds whether a policy fits: spaces, normalisation, determinism, memory, speed. Exit code 2: no."""
    from rare_envs.study.ego_check import VERDICTS, check_ego, exit_code, print_findings

    findings = check_ego(Question(env_id=env, ego=ego, **asked), time_limit)
    code = exit_code(findings)
    found = [asdict(each) for each in findings]
    data = {"ego": ego, "env_id": env, "verdict": VERDICTS[code], "findings": found}
    return Answer(data, partial(print_findings, findings, f"{ego} in {env}", show_all), code)


@command("trust")
def report_command(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="Folder of --out of estimate, risk or compare.")],
    asked: dict[str, Any],
    out: Annotated[Path | None, Option(help="HTML file; by default report.html in FOLDER.")] = None,
    events: Annotated[
        Path | None,
        Option(help="CSV file of recorded events, with columns named as the parameters, to compare the crashes with."),
    ] = None,
    figures: Annotated[str | None, Option(help="Format of figures as files too: svg, pdf or png.")] = None,
    evidence: Annotated[
        bool,
        Option(
            "--evidence",
            help="Write files for a safety case too: coverage, uncertainty, checks, test cases and a claim tree.",
        ),
    ] = False,
    force: ForceOption = False,
) -> Answer:
    """Write the report of a run, a risk or a comparison as one HTML file, with films of its failures."""
    from rare_envs.study.evidence import sum_up, write_evidence
    from rare_envs.study.html_report import write_html_report
    from rare_envs.study.run_folder import MOST_NAMED

    refuse_existing(force, out, out and out.parent / "figures" if figures else None)
    files = write_evidence(folder, **asked) if evidence else ()
    page, *drawn = write_html_report(folder, events=events, out=out, figures=figures, **asked)
    filed, (changed, manifest, digest) = [str(path) for path in files], sum_up(files) if files else ([], "", "")
    text = f"Wrote {page}{f' and {len(drawn)} figures' if drawn else ''}."
    text += "".join(f"\nWrote {path} and the files beside it." for path in filed if path.endswith(".html"))
    if changed:
        more = f" and {len(changed) - MOST_NAMED} more" if len(changed) > MOST_NAMED else ""
        named = f"{', '.join(changed[:MOST_NAMED])}{more}"
        text += f"\nChanged since they were written, or not what is computed again: {named}."
    data = {"report": str(page), "figures": [str(path) for path in drawn], "evidence": filed, "changed": changed}
    if files:
        data["sha256"] = digest
        text += f"\nKeep elsewhere, as it has the digests of all: {manifest}, SHA-256 {digest}"
    return Answer(data, text, DOUBTFUL if changed else 0)


@command("trust")
def corpus_add_command(
    run: RunArgument,
    asked: dict[str, Any],
    typed: set[str],
    corpus: CorpusOption = Path("corpus"),
    limit: Annotated[
        int, Option(help="Largest number of failures to add: one of each kind of crash, then the most likely.")
    ] = 20,
) -> Answer:
    """Add the failures of a run to a corpus, one file each."""
    from rare_envs.study.corpus import add_run

    # the working directory may be somebody else's
    with output_folder(corpus.parent, folders=() if "corpus" in typed else (corpus.name,)):
        chosen, new = add_run(run, corpus, limit, **asked)
    text = f"Added {new} of {len(chosen)} failures to {corpus}{'' if new else '; it had all of them'}."
    return Answer({"corpus": str(corpus), "added": new, "failures": [each.key for each in chosen]}, text)


@command(*EGO_FILE, "observation", "action", "trust")
def corpus_run_command(
    ego: Annotated[str, Option(help="Policy under test, as for estimate --ego.")],
    asked: dict[str, Any],
    corpus: CorpusOption = Path("corpus"),
    junit: Annotated[Path | None, Option(help="File of a JUnit report to write.")] = None,
    force: ForceOption = False,
) -> Answer:
    """Test an ego in all scenarios of a corpus. Exit code 0: it fails in none; 4: it fails."""
    from rare_envs.study.corpus import read_corpus, try_ego, write_junit

    with output_file(junit, force or _is_junit(junit)):
        trials, seconds = try_ego(read_corpus(corpus), corpus, ego, **asked)
        if junit is not None:
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
    outcomes = Counter(trial.outcome for trial in trials)
    counts = {outcome: outcomes[outcome] for outcome in ("passed", "failed", "error")}
    return {**counts, "seconds": seconds, "trials": [trial.to_dict() for trial in trials]}


def _list(trials: Sequence[Trial]) -> list[str]:
    """Return a line for each trial, the first `MOST_SHOWN`."""
    lines = [f"  {each.failure.key}  {each.failure.env_id}  {each.describe()}" for each in trials[:MOST_SHOWN]]
    rest = len(trials) - MOST_SHOWN
    return lines if rest <= 0 else [*lines, f"  and {rest:,} more; --json has all."]


def _choose_failure(run: Path, failure: int, mode: int | None, typed: set[str]) -> int:
    """Return the number of the failure that --failure or --mode means."""
    if mode is None:
        return failure
    if "failure" in typed:
        raise BadInput("Expected --failure or --mode, not both.")
    from rare_envs.study.run_folder import load_finished

    numbers = load_finished(run).modes
    if not numbers:
        raise BadInput("The run has no kinds of crash: give --failure.")
    if mode > len(numbers):
        kinds = f"{len(numbers)} kinds" if len(numbers) != 1 else "1 kind"
        raise BadInput(f"Expected --mode from 1 to {len(numbers)}, got {mode}: the run has {kinds} of crash.")
    if (number := numbers[mode - 1]) is None:
        raise BadInput(f"The run lists no failure of the crash kind {mode}: give --failure.")
    return number


@command("trust")
def replay_command(
    run: RunArgument,
    asked: dict[str, Any],
    typed: set[str],
    failure: FailureOption = 0,
    mode: ModeOption = None,
    out: Annotated[Path | None, Option(help="File to write: .gif of the drive, or .png of its worst moment.")] = None,
    ego: Annotated[str | None, Option(help="Another policy, as for estimate --ego, in place of the run's.")] = None,
    replay_each: Annotated[
        bool, Option("--all", help="Simulate all failures again and compare their f, without a film.")
    ] = False,
    force: ForceOption = False,
) -> Answer:
    """Replay a failure that a run has found, and show it with its safety measure over time."""
    from rare_envs.study.plots import check_film_path, write_film
    from rare_envs.study.replay import REPLAY_TOLERANCE, describe_drive, drive_again, find_failure

    if replay_each:
        if out is not None:
            raise BadInput("Expected --all without --out: a film shows one failure.")
        if given := sorted(typed & {"failure", "mode"}):
            raise BadInput(f"Expected --all without --{given[0]}: it simulates all of them.")
        return replay_all(run, ego, **asked)
    failure = _choose_failure(run, failure, mode, typed)
    if out is not None:
        check_film_path(out)
    with output_file(out, force):
        recorded = find_failure(run, failure, asked["trust"], ego)
        drive = drive_again(recorded.problem, recorded.x)
        if out is not None:
            write_film(out, drive)
    same = abs(drive.f - recorded.f) <= REPLAY_TOLERANCE
    data: dict[str, Any] = {"failure": failure, "failures": recorded.n_listed, "n_failures": recorded.n_found}
    data |= {"f": drive.f, "f_recorded": recorded.f, "same": same, "log_p0": recorded.log_p0}
    data |= {"seconds": float(drive.time[-1]), "crash": drive.crash, "out": out and str(out), "ego": ego}
    lines = [*describe_drive(recorded, drive, failure, ego), *([] if out is None else [f"Wrote {out}."])]
    return Answer(data, "\n".join(lines), 0 if same or ego is not None else DOUBTFUL)


@command(*EGO_FILE, "trust")
def export_command(
    source: Annotated[
        str, Argument(metavar="RUN|EGO", help="Folder of a run, whose failure is exported; or a policy file (.zip).")
    ],
    asked: dict[str, Any],
    typed: set[str],
    target: Annotated[
        Path | None, Argument(metavar="OUT", help="File to write: .xosc or .xml of a failure, .onnx of a policy.")
    ] = None,
    out: Annotated[Path | None, Option(help="The same as OUT.")] = None,
    failure: FailureOption = 0,
    mode: ModeOption = None,
    format: Annotated[
        str, Option(help="Format of a failure: openscenario, carla (for scenario_runner) or commonroad.")
    ] = "openscenario",
    ego: Annotated[
        str | None,
        Option(
            help="Ego of a failure: recorded (it follows its trajectory) or free (it only has a start, as for carla)."
        ),
    ] = None,
    force: ForceOption = False,
) -> Answer:
    """Write a failure as OpenSCENARIO (with OpenDRIVE) or CommonRoad, or a policy as ONNX."""
    if (target is None) == (out is None):
        raise BadInput(
            "Expected one file to write: rare-envs export RUN crash.xosc, or rare-envs export EGO.zip EGO.onnx."
        )
    file = target or out
    assert file is not None
    run, of_run = Path(source), {"failure", "mode", "format", "ego"}
    is_run = run.is_dir()
    if wrong := sorted(typed & (set(EGO_FILE) if is_run else of_run)):
        raise BadInput(
            f"Expected --{wrong[0]} with {'a policy file' if is_run else 'the folder of a run'}, got {source!r}."
        )
    if not is_run and (run.suffix == ".zip" or file.suffix == ".onnx"):
        return _export_ego(run, file, force, asked)
    from rare_envs.study.export import check_export, export_scenario
    from rare_envs.study.replay import find_failure

    number = _choose_failure(run, failure, mode, typed)
    with as_bad_input(ValueError):
        check_export(file, format, ego)
        refuse_existing(force or format == "commonroad", file.with_suffix(".xodr"))
        with output_file(file, force):
            recorded = find_failure(run, number, asked["trust"])
            files = export_scenario(recorded.problem, recorded.x, file, format, ego)  # type: ignore[arg-type]
    names = [str(path) for path in files]
    data = {"failure": number, "failures": recorded.n_listed, "format": format, "files": names}
    return Answer(data, f"Wrote {' and '.join(names)}.")


def _export_ego(model: Path, out: Path, force: bool, asked: Mapping[str, Any]) -> Answer:
    """Write a saved policy as ONNX, normalisation, memory and clipping included, and check that both act alike."""
    if model.suffix != ".zip":
        raise BadInput(
            f"Only policies saved by Stable-Baselines3, files that end in .zip, are exported; got {str(model)!r}."
        )
    if out.suffix != ".onnx":
        raise BadInput(f"Expected a file that ends in .onnx, got {str(out)!r}.")
    with output_file(out, force), as_bad_input(ValueError, OSError):
        from agents.onnx import ACTION_TOLERANCE, export_onnx
        from agents.saved_ego import load_saved_ego

        ego = load_saved_ego(model, asked["algo"], asked["trust"], asked["stats"])
        difference, tried = export_onnx(ego, out)
    statistics = ego.statistics_path and str(ego.statistics_path)
    data: dict[str, Any] = {
        "model": str(model),
        "algorithm": ego.algorithm,
        "vec_normalize": statistics,
        "onnx": str(out),
    }
    data |= {"largest_difference": difference, "tolerance": ACTION_TOLERANCE, "observations_tried": tried}
    found = f"its actions differ by {difference:.1e} at most on {tried:,} random observations"
    return Answer(data, f"Wrote {out}: {found}.")
