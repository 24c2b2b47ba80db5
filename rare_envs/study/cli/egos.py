"""Commands about egos and traffic: `train-ego`, `train-drivers`, `fit`, `check-ego`, `serve-ego`, `export-ego`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from rare_envs.scenarios.registry import find_scenario
from rare_envs.startup import advise_install
from rare_envs.study.arguments import BadInput, Question, as_bad_input, output_file, output_folder
from rare_envs.study.cli import shell
from rare_envs.study.cli.shell import Answer, command
from training.command_line import DriverTrainingOptions, EventOptions, RecordingOptions, RunFolderOption, spread_options

if TYPE_CHECKING:
    from rare_envs.study.corpus import RetrainingPlan

USUAL = {"noise": "on", "observation": "features", "action": "continuous", "collisions": "ego"}
"""Options of `estimate` that need not be typed for an ego that is trained here."""


@command(*shell.WORLD, "seed", "trust")
def train_ego_command(
    asked: dict[str, Any],
    envs: Annotated[
        list[str] | None,
        Argument(
            metavar="[ENV]...",
            help="Environments, such as rare_envs/CutIn-v1, or all: those of rare-envs risk; --from-failures tells it.",
        ),
    ] = None,
    algo: Annotated[
        str | None, Option(help="Stable-Baselines3 algorithm; --from-failures tells it.", show_default="ppo")
    ] = None,
    steps: Annotated[
        int, Option(help="Environment steps to train for.", parser=shell.read_count, metavar="INTEGER")
    ] = 200_000,
    out: Annotated[Path, Option(help="File to save the ego in.")] = Path("ego.zip"),
    num_envs: Annotated[int, Option(help="Episodes that run side by side.")] = 256,
    device: Annotated[str, Option(help="Where to simulate and to train: cpu, or a GPU (cuda, cuda:1).")] = "cpu",
    resume: Annotated[bool, Option("--resume", help="Go on with a training that was interrupted.")] = False,
    force: shell.ForceOption = False,
    from_failures: Annotated[
        list[Path] | None,
        Option(
            metavar="RUN",
            help="Train the ego of this run of rare-envs estimate on, with its failures among ordinary scenarios; "
            "repeated, the ego of the last run with the failures of all.",
        ),
    ] = None,
    failure_share: Annotated[
        float, Option(help="Share of episodes that begin in a failure, with --from-failures.")
    ] = 0.25,
    even_strata: Annotated[
        bool,
        Option(
            "--even-strata/--shares",
            help="Draw the kinds of an event equally often, or as often as they happen: of the cutters of CutIn-v1 "
            "one in 6,000 does not look.",
        ),
    ] = True,
) -> Answer:
    """Train an ego on the batched simulation and save it for `rare-envs estimate --ego` and `rare-envs risk`.

    A new one in the environments, all of them at once, or by --from-failures the ego of a run, in the world of that
    run.
    """
    from training import train_ego
    from training.ego_training import HYPERPARAMETERS

    seed, trust = asked.pop("seed"), asked.pop("trust")
    ids, plan = _read_environments(envs or []), None
    if from_failures:
        plan = _read_plan(from_failures, failure_share, trust, ids, algo, asked)
        ids, algo, world = (plan.env_id,), plan.algo, dict(plan.world)
    elif not ids:
        raise BadInput("Expected an environment, such as rare_envs/CutIn-v1, or --from-failures RUN; rare-envs list.")
    else:
        algo = algo or "ppo"
        world = {**asked, **{name: asked[name] or USUAL[name] for name in ("observation", "action")}}
    retraining = None if plan is None else plan.retraining
    settings: dict[str, Any] = {**world, "retraining": retraining, **({} if device == "cpu" else {"device": device})}
    settings["even_strata"] = even_strata
    with as_bad_input(ValueError, OSError):
        path = train_ego(
            ids, algo, steps, out=out, seed=seed, num_envs=num_envs, resume=resume, force=force, **settings
        )
    data = {"ego": str(path), "env_id": ids[0] if len(ids) == 1 else ids, "algo": algo, "steps": steps, "seed": seed}
    data |= {**world, "even_strata": even_strata}
    if retraining is not None:
        data |= {"retrained": str(retraining.ego), "failures": len(retraining.failures)}
        data["failure_share"] = retraining.share
    if HYPERPARAMETERS[algo].discrete and asked["action"] is None:
        world["action"] = "discrete"  # which is what the algorithm made of it
    told = {**world, "noise": next(word for word, argument in shell.NOISE.items() if argument == world["noise"])}
    told |= {"weather": None, "seed": None if plan is None else plan.next_seed}
    options, ego = {name: each for name, each in told.items() if each not in (None, USUAL.get(name))}, str(path)
    if len(ids) == 1:
        words = ["estimate", *ids, "--ego", ego, *(word for name in options for word in (f"--{name}", options[name]))]
        words += ["--weather"] if world["weather"] else []
    else:  # which has a base for each scenario, and none of the other options
        words = ["risk", ego]
        for name in sorted({"observation", "action"} & {*options}):
            words += [f"--{name}", options[name]]
        names = (find_scenario(env_id).name for env_id in ids) if "base" in options else ()
        words += [word for name in names for word in ("--base", f"{name}={options['base']}")]
    return Answer(data, f"Saved {path}. Next: rare-envs {shlex.join(map(str, words))}")


def _read_environments(names: Sequence[str]) -> tuple[str, ...]:
    """Return the ids of environments, those of `risk` for "all"."""
    from rare_envs.scenarios.registry import complete_id, env_id_of
    from rare_envs.study.risk import SCENARIO_SET

    return tuple(map(env_id_of, SCENARIO_SET)) if [*names] == ["all"] else tuple(map(complete_id, names))


def _read_plan(
    runs: list[Path], share: float, trust: bool, ids: Sequence[str], algo: str | None, asked: Mapping[str, Any]
) -> RetrainingPlan:
    """Return how to train on with the failures of runs."""
    from rare_envs.study.corpus import plan_retraining

    if any(value != getattr(Question, name) for name, value in asked.items()):
        raise BadInput("The world of --from-failures is that of the run: leave --base, --drivers and the like out.")
    plan = plan_retraining(runs, share, trust)
    for name, given, own in (("ENV", " ".join(ids), plan.env_id), ("--algo", algo, plan.algo)):
        if given not in ("", None, own):
            raise BadInput(f"Expected {name} {own}, that of the run in {str(runs[-1])!r}, got {given!r}; leave it out.")
    return plan


@spread_options
@command()
def train_drivers_command(out: RunFolderOption, recordings: RecordingOptions, options: DriverTrainingOptions) -> Answer:
    """Train background drivers from recorded traffic; `python -m training.imitation` has every setting."""
    from training.imitation.config import Config
    from training.imitation.train import Source, train_driver

    with as_bad_input(ValueError, OSError):
        config = Config(options.method, options.seed, options.updates)
        path = train_driver(Source(*recordings.kind_and_path()), config, out, progress=True, device=options.device)
    data = {"driver": str(path), "method": options.method, "seed": options.seed}
    return Answer(data, f"Saved {path}. Load it with agents.load_driver({str(path)!r}).")


@spread_options
@command()
def fit_command(
    out: Annotated[Path, Option(help="Folder for the JSON files.")],
    recordings: EventOptions,
    cut_gaps: Annotated[bool, Option("--cut-gaps", help="Cut tracks where frames are missing.")] = False,
    scenario: Annotated[
        list[str] | None, Option(help="Which to fit, may be repeated; all that have enough events by default.")
    ] = None,
    name: Annotated[str, Option(help="Name of the bases of your own recordings.")] = "own",
    refits: Annotated[int | None, Option(help="Refits: 30, or 100 where their components differ.", min=2)] = None,
    seed: Annotated[int, Option(help="Seed of the fits.", min=0)] = 0,
    force: shell.ForceOption = False,
) -> Answer:
    """Fit base distributions to recorded traffic, with refits that say how far the events determine them."""
    from training.fit.recordings import fit_bases

    settings: dict[str, Any] = {"scenarios": scenario, "name": name, "n_refits": refits, "seed": seed, "force": force}
    with output_folder(out), as_bad_input(ValueError, OSError):
        files = fit_bases(recordings, out, cut_gaps=cut_gaps, progress=True, **settings)
    lines = [f"{path}: rare-envs estimate ENV --base {path}" for path in files]
    return Answer({"bases": [str(path) for path in files]}, "\n".join(lines))


@command(*shell.SCENARIO, *shell.EGO_FILE, "trust")
def check_ego_command(
    ego: shell.EgoArgument,
    env: shell.EnvArgument,
    asked: dict[str, Any],
    time_limit: Annotated[float, Option(help="Seconds that one check may take.")] = 30.0,
    show_all: Annotated[bool, Option("--all", help="Show each check that passed in a row of its own.")] = False,
) -> Answer:
    """Check in seconds whether an ego fits: spaces, normalisation, determinism, memory, speed. 2: it does not."""
    from rare_envs.study.ego_check import VERDICTS, exit_code, print_findings
    from rare_envs.study.ego_check.subprocess_check import check_ego

    findings = check_ego(Question(env_id=env, ego=ego, **asked), time_limit)
    code = exit_code(findings)
    found = [asdict(each) for each in findings]
    data = {"ego": ego, "env_id": env, "verdict": VERDICTS[code], "findings": found}
    return Answer(data, partial(print_findings, findings, f"{ego} in {env}", show_all), code)


@command(*shell.EGO_FILE, "trust")
def serve_ego_command(
    ego: shell.EgoArgument,
    asked: dict[str, Any],
    bind: Annotated[str, Option(help="Address; beyond 127.0.0.1 it needs RARE_ENVS_SECRET.")] = "tcp://127.0.0.1:5555",
) -> None:
    """Serve an ego to simulations in other processes or on other machines (estimate --ego tcp://...)."""
    import agents
    from rare_envs.plugins import is_policy

    try:
        from agents.remote.protocol import read_secret
        from agents.remote.server import EgoServer
    except ImportError as error:
        raise BadInput(f"Serving needs pyzmq and msgpack: {advise_install('remote')}.") from error
    with as_bad_input(ValueError, OSError):
        loaded = agents.load_ego(ego, **asked)
        if not is_policy(loaded):
            raise ValueError(f"Expected an ego with predict, got {ego!r}, which needs more than observations.")
        server = EgoServer(loaded, bind, read_secret(), name=ego)
    with server:
        shell.print_stderr(f"Serving {ego} at {server.address}; stop with Ctrl-C.")
        server.run()


@command(*shell.EGO_FILE, "trust")
def export_ego_command(
    asked: dict[str, Any],
    model: Annotated[Path, Argument(metavar="MODEL", help="A .zip saved by Stable-Baselines3.")],
    out: Annotated[Path, Argument(metavar="OUT", help="The .onnx file to write.")],
    force: shell.ForceOption = False,
) -> Answer:
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
    data = {
        "model": str(model),
        "algorithm": ego.algorithm,
        "vec_normalize": None if ego.statistics_path is None else str(ego.statistics_path),
        "onnx": str(out),
        "largest_difference": difference,
        "tolerance": ACTION_TOLERANCE,
        "observations_tried": tried,
    }
    found = f"its actions differ by {difference:.1e} at most on {tried:,} random observations"
    return Answer(data, f"Wrote {out}: {found}.")
