"""Commands about egos and traffic: `train-ego`, `train-drivers`, `fit`, `check-ego`, `serve-ego`, `export-ego`."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rare_envs.study.cli.options import (
    AlgoOption,
    EgoArgument,
    EnvArgument,
    JsonOption,
    NoiseChoice,
    ScenarioOptions,
    SeedOption,
    StatsOption,
    TrustOption,
    WorldOptions,
    read_count,
    read_environment,
)
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, as_bad_input, output_file
from rare_envs.threads import use_one_thread
from training.command_line import DriverTrainingOptions, EventOptions, RecordingOptions, RunFolderOption, spread_options

if TYPE_CHECKING:
    from rare_envs.study.corpus import RetrainingPlan
    from training import Retraining


@spread_options
@use_one_thread()
def train_ego_command(
    options: WorldOptions,
    env: Annotated[
        str | None,
        typer.Argument(
            metavar="[ENV]",
            help="Environment, such as rare_envs/CutIn-v0; --from-failures tells it.",
            callback=read_environment,
        ),
    ] = None,
    algo: Annotated[
        str | None,
        typer.Option(
            help="Stable-Baselines3 algorithm; --from-failures tells it.",
            show_default="ppo",
        ),
    ] = None,
    steps: Annotated[
        int, typer.Option(help="Environment steps to train for.", parser=read_count, metavar="INTEGER")
    ] = 200_000,
    out: Annotated[Path, typer.Option(help="File to save the ego in.")] = Path("ego.zip"),
    seed: SeedOption = 0,
    num_envs: Annotated[int, typer.Option(help="Episodes that run side by side.")] = 256,
    device: Annotated[
        str,
        typer.Option(
            help="Where to simulate and to train: cpu, or a GPU (cuda, cuda:1).",
        ),
    ] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a training that was interrupted.")] = False,
    from_failures: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN",
            help="Train the ego of this run of rare-envs estimate on, with its failures among ordinary scenarios; "
            "repeated, the ego of the last run with the failures of all.",
        ),
    ] = None,
    failure_share: Annotated[
        float, typer.Option(help="Share of episodes that begin in a failure, with --from-failures.")
    ] = 0.25,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train an ego on the batched simulation and save it for `rare-envs estimate --ego`.

    A new one in ENV, or by --from-failures the ego of a run, in the world of that run.
    """
    from training import train_ego
    from training.ego_training import HYPERPARAMETERS

    if from_failures:
        plan = _read_plan(from_failures, failure_share, trust, env, algo, options)
        env, algo, world, retraining = plan.env_id, plan.algo, dict(plan.world), plan.retraining
        noise, next_seed = NoiseChoice.of(world["noise"]), plan.next_seed
    elif env is None:
        raise BadInput("Expected an environment, such as rare_envs/CutIn-v0, or --from-failures RUN; rare-envs list.")
    else:
        algo, noise, retraining, next_seed = algo or "ppo", options.noise, None, None
        asked = {"observation": options.observation or "features", "action": options.action or "continuous"}
        world = {**options.arguments(), **asked}
    place: dict[str, Any] = {} if device == "cpu" else {"device": device}
    with as_bad_input(ValueError, OSError):
        path = train_ego(
            env,
            algo=algo,
            steps=steps,
            out=out,
            seed=seed,
            num_envs=num_envs,
            resume=resume,
            retraining=retraining,
            **world,
            **place,
        )
    if as_json:
        answer = {"ego": str(path), "env_id": env, "algo": algo, "steps": steps, "seed": seed, **world}
        print_json(answer | ({} if retraining is None else _describe_retraining(retraining)))
        return
    if HYPERPARAMETERS[algo].discrete and options.action is None:
        world["action"] = "discrete"  # which is what the algorithm made of it
    seed_words = "" if next_seed is None else f" --seed {next_seed}"
    words = f"rare-envs estimate {env} --ego {shlex.quote(str(path))}{_estimate_options(world, noise)}{seed_words}"
    print(f"Saved {path}. Next: {words}")


def _read_plan(
    runs: list[Path], share: float, trust: bool, env: str | None, algo: str | None, options: WorldOptions
) -> RetrainingPlan:
    """Return how to train on with the failures of runs."""
    from rare_envs.study.corpus import plan_retraining

    if options != WorldOptions():
        raise BadInput("The world of --from-failures is that of the run: leave --base, --drivers and the like out.")
    with keep_stdout_for_the_answer():
        plan = plan_retraining(runs, share, trust)
    for name, given, own in (("ENV", env, plan.env_id), ("--algo", algo, plan.algo)):
        if given not in (None, own):
            raise BadInput(f"Expected {name} {own}, that of the run in {str(runs[-1])!r}, got {given!r}; leave it out.")
    return plan


def _describe_retraining(retraining: Retraining) -> dict[str, Any]:
    failures, share = len(retraining.failures), retraining.share
    return {"retrained": str(retraining.ego), "failures": failures, "failure_share": share}


def _estimate_options(world: dict[str, Any], noise: NoiseChoice) -> str:
    """Return the options with which `estimate` makes the world that an ego was trained in."""
    usual = {"noise": NoiseChoice.ON.value, "observation": "features", "action": "continuous", "collisions": "ego"}
    values = {**world, "noise": noise.value, "weather": None}
    told = {name: str(value) for name, value in values.items() if value not in (None, usual.get(name))}
    words = "".join(f" --{name} {shlex.quote(value)}" for name, value in told.items())
    return words + (" --weather" if world["weather"] else "")


@spread_options
@use_one_thread()
def train_drivers_command(
    out: RunFolderOption, recordings: RecordingOptions, options: DriverTrainingOptions, as_json: JsonOption = False
) -> None:
    """Train background drivers from recorded traffic; `python -m training.imitation.train` has every setting."""
    from training.imitation.algorithms.config import Config
    from training.imitation.datasets import Source
    from training.imitation.run_folder import train_driver

    method = options.method.value
    with as_bad_input(ValueError):
        config = Config(method, options.seed, options.updates)  # type: ignore[arg-type]  # the options are its methods
        path = train_driver(Source(*recordings.kind_and_path()), config, out, progress=True, device=options.device)
    if as_json:
        print_json({"driver": str(path), "method": method, "seed": options.seed})
    else:
        print(f"Saved {path}. Load it with agents.load_driver({str(path)!r}).")


@spread_options
@use_one_thread()
def fit_command(
    out: Annotated[Path, typer.Option(help="Folder for the JSON files.")],
    recordings: EventOptions,
    cut_gaps: Annotated[bool, typer.Option("--cut-gaps", help="Cut tracks where frames are missing.")] = False,
    scenario: Annotated[
        list[str] | None, typer.Option(help="Which to fit, may be repeated; all that have enough events by default.")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the bases of your own recordings.")] = "own",
    refits: Annotated[int | None, typer.Option(help="Refits: 30, or 100 where their components differ.", min=2)] = None,
    seed: Annotated[int, typer.Option(help="Seed of the fits.", min=0)] = 0,
    as_json: JsonOption = False,
) -> None:
    """Fit base distributions to recorded traffic, with refits that say how far the events determine them."""
    from training.scenario_fitting.fit import fit_bases

    with keep_stdout_for_the_answer(), as_bad_input(ValueError, OSError):
        files = fit_bases(
            recordings,
            out,
            cut_gaps=cut_gaps,
            scenarios=scenario,
            name=name,
            n_refits=refits,
            seed=seed,
            progress=True,
        )
    if as_json:
        print_json({"bases": [str(path) for path in files]})
    else:
        print("\n".join(f"{path}: rare-envs estimate ENV --base {path}" for path in files))


@spread_options
def check_ego_command(
    ego: EgoArgument,
    env: EnvArgument,
    options: ScenarioOptions,
    algo: AlgoOption = None,
    stats: StatsOption = None,
    trust: TrustOption = False,
    time_limit: Annotated[float, typer.Option(help="Seconds that one check may take.")] = 30.0,
    show_all: Annotated[bool, typer.Option("--all", help="Show each check that passed in a row of its own.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check in seconds whether an ego fits: spaces, normalisation, determinism, memory, speed. 2: it does not."""
    from rare_envs.study.ego_check.findings import VERDICTS, exit_code, print_findings
    from rare_envs.study.ego_check.subprocess_check import EgoCheckRequest, check_ego

    request = EgoCheckRequest(ego, env, algo, trust, stats=stats, time_limit=time_limit, **options.arguments())
    findings = check_ego(request)
    code = exit_code(findings)
    if as_json:
        print_json(
            {"ego": ego, "env_id": env, "verdict": VERDICTS[code], "findings": [asdict(each) for each in findings]}
        )
    else:
        print_findings(findings, f"{ego} in {env}", show_all)
    raise typer.Exit(code)


@use_one_thread()
def serve_ego_command(
    ego: EgoArgument,
    bind: Annotated[
        str, typer.Option(help="Address; beyond 127.0.0.1 it needs RARE_ENVS_SECRET.")
    ] = "tcp://127.0.0.1:5555",
    algo: AlgoOption = None,
    stats: StatsOption = None,
    trust: TrustOption = False,
) -> None:
    """Serve an ego to simulations in other processes or on other machines (estimate --ego tcp://...)."""
    serve_ego(ego, bind, algo=algo, trust=trust, stats=stats)


def serve_ego(spec: str, bind: str, algo: str | None = None, trust: bool = False, stats: str | None = None) -> None:
    """Answer requests for an ego until it is interrupted.

    Args:
        spec: As for `agents.load_ego`.
        bind: Address to listen on, such as "tcp://127.0.0.1:5555".
        algo: Algorithm of a `.zip`, if the file does not tell.
        trust: As for `agents.load_ego`.
        stats: Likewise.

    Raises:
        BadInput: The ego cannot be loaded or served, or the address cannot be used.
    """
    import agents
    from rare_envs.egos.validation import is_policy

    try:
        from agents.remote.server import EgoServer
        from agents.remote.zmq_link import read_secret
    except ImportError as error:
        raise BadInput("Serving needs pyzmq and msgpack: pip install 'rare-envs[remote]'.") from error
    try:
        ego = agents.load_ego(spec, algo=algo, trust=trust, stats=stats)
        if not is_policy(ego):
            raise ValueError(f"Expected an ego with predict, got {spec!r}, which needs more than observations.")
        server = EgoServer(ego, bind, read_secret(), name=spec)
    except (ValueError, OSError) as error:
        raise BadInput(error) from error
    with server:
        print(f"Serving {spec} at {server.address}; stop with Ctrl-C.", file=sys.stderr, flush=True)
        server.run()


def export_ego_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A .zip saved by Stable-Baselines3.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The .onnx file to write.")],
    algo: AlgoOption = None,
    stats: StatsOption = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a saved policy as ONNX, normalisation, memory and clipping included, and check that both act alike."""
    with keep_stdout_for_the_answer():
        done = export_ego(model, out, algo=algo, trust=trust, stats=stats)
    if as_json:
        print_json(done)
    else:
        print(
            f"Wrote {out}: its actions differ by {done['largest_difference']:.1e} at most "
            f"on {done['observations_tried']:,} random observations."
        )


def export_ego(
    model: Path, out: Path, algo: str | None = None, trust: bool = False, stats: str | None = None
) -> dict[str, Any]:
    """Write a Stable-Baselines3 `.zip` as ONNX and check that both act alike.

    Args:
        model: The `.zip`.
        out: The file to write, ending in `.onnx`.
        algo: Algorithm of the `.zip`, if the file does not tell.
        trust: As for `agents.load_ego`.
        stats: Likewise.

    Returns:
        What was written, JSON-ready.

    Raises:
        BadInput: The model cannot be read, the file cannot be written, or they act differently.
    """
    if model.suffix != ".zip":
        raise BadInput(
            f"Only policies saved by Stable-Baselines3, files that end in .zip, are exported; got {str(model)!r}."
        )
    if out.suffix != ".onnx":
        raise BadInput(f"Expected a file that ends in .onnx, got {str(out)!r}.")
    with output_file(out), as_bad_input(ValueError, OSError):
        from agents.onnx.export import ACTION_TOLERANCE, export_onnx
        from agents.sb3.saved_ego import load_saved_ego

        ego = load_saved_ego(model, algo, trust, stats)
        exported = export_onnx(ego, out)
    return {
        "model": str(model),
        "algorithm": ego.algorithm,
        "vec_normalize": None if ego.statistics_path is None else str(ego.statistics_path),
        "onnx": str(exported.path),
        "largest_difference": exported.difference,
        "tolerance": ACTION_TOLERANCE,
        "observations_tried": exported.observations,
    }
