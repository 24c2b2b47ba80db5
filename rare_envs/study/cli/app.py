"""The command line `rare-envs`: reads words, calls one function, prints. The work is done elsewhere.

Exit codes: 0 done, 2 bad input (one line on standard error), 3 done with warnings that make the number doubtful.
"""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from rare_envs.study.cli.options import (
    Action,
    Algo,
    Base,
    Collisions,
    Drivers,
    Ego,
    Env,
    Gamma,
    Horizon,
    Json,
    Measure,
    Method,
    Noise,
    NoiseOption,
    Observation,
    Seed,
    Shown,
    Trust,
    Weather,
)
from rare_envs.study.cli.shell import OneLineErrors, one_thread, print_json

DOUBTFUL = 3

app = typer.Typer(
    cls=OneLineErrors,
    help="How often does a driving policy crash? Train one, estimate its rare failures, see the most likely.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.command("list")
def list_command(as_json: Json = False) -> None:
    """Show environments with their parameters, methods, egos, measures and base distributions."""
    from rare_envs.study.cli.catalogue import catalogue
    from rare_envs.study.cli.printing import print_catalogue

    if as_json:
        print_json(catalogue())
    else:
        print_catalogue(catalogue())


@app.command("estimate")
def estimate_command(
    env: Env,
    ego: Annotated[
        str,
        typer.Option(help="A name, a .zip or .onnx, module:function, tcp://..., noisy:EGO; see rare-envs list."),
    ] = "idm",
    algo: Algo = None,
    trust: Trust = False,
    method: Method = "two-stage",
    base: Base = None,
    measure: Measure = "ttc",
    gamma: Gamma = 0.0,
    seed: Seed = 0,
    max_sim: Annotated[int | None, typer.Option(help="Largest number of simulations.")] = None,
    target_cov: Annotated[float | None, typer.Option(help="Stop at this coefficient of variation.")] = None,
    replicates: Annotated[int, typer.Option(help="Independent runs, combined by their mean.")] = 1,
    drivers: Drivers = None,
    noise: NoiseOption = Noise.ON,
    observation: Shown = None,
    weather: Weather = False,
    action: Action = "continuous",
    horizon: Horizon = None,
    on_error: Annotated[str, typer.Option(help="Where the ego fails twice: raise, failure or bound.")] = "raise",
    collisions: Collisions = "ego",
    out: Annotated[Path | None, typer.Option(help="Folder for result.json, failures.csv and plot.png.")] = None,
    as_json: Json = False,
) -> None:
    """Estimate how often an ego fails, with an interval, and show its most likely failure."""
    one_thread()
    from rare_envs.study import evaluate
    from rare_envs.study import run_directory as rundir

    question = evaluate.Question(
        env_id=env,
        ego=ego,
        algo=algo,
        trust=trust,
        method=method,
        base=base,
        measure=measure,
        gamma=gamma,
        seed=seed,
        max_sim=max_sim,
        target_cov=target_cov,
        replicates=replicates,
        noise=noise.argument,
        drivers=drivers,
        observation=observation,
        weather=weather,
        action=action,
        horizon=horizon,
        on_error=on_error,
        collisions=collisions,
    )
    with contextlib.redirect_stdout(sys.stderr):  # an ego may print, and standard output is for the answer
        study = evaluate.prepare(question)
        report = evaluate.run(study, progress=True) if out is None else rundir.run_into(out, study, progress=True)
    _answer(report, out, as_json)


def _answer(report: Any, out: Path | None, as_json: bool) -> NoReturn:
    """Print a report and exit."""
    from rare_envs.study.cli.printing import print_report

    if as_json:
        print_json(report.to_dict())
    else:
        print_report(report, out)
    raise typer.Exit(DOUBTFUL if report.doubtful else 0)


@app.command("resume")
def resume_command(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of an estimate --out that has not come to its end.")
    ],
    ego: Annotated[str | None, typer.Option(help="New address of an ego in another program, tcp://...")] = None,
    on_error: Annotated[str | None, typer.Option(help="Instead of what the run had: raise, failure or bound.")] = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Go on with a run whose ego has gone, or that was stopped; the answer is that of an undisturbed run."""
    one_thread()
    from rare_envs.study.run_directory import resume

    with contextlib.redirect_stdout(sys.stderr):
        report = resume(run, ego, on_error, trust, progress=True)
    _answer(report, run, as_json)


@app.command("compare")
def compare_command(
    ego_a: Annotated[str, typer.Argument(metavar="EGO_A", help="An ego, as for estimate --ego.")],
    ego_b: Annotated[str, typer.Argument(metavar="EGO_B", help="The other ego.")],
    env: Env,
    trust: Trust = False,
    method: Method = "two-stage",
    base: Base = None,
    measure: Measure = "ttc",
    gamma: Gamma = 0.0,
    seed: Seed = 0,
    max_sim: Annotated[int, typer.Option(help="Largest number of simulations, of both egos together.")] = 12_000,
    drivers: Drivers = None,
    noise: NoiseOption = Noise.ON,
    observation: Shown = None,
    weather: Weather = False,
    action: Action = "continuous",
    horizon: Horizon = None,
    collisions: Collisions = "ego",
    out: Annotated[Path | None, typer.Option(help="Folder for comparison.json and failures.csv.")] = None,
    as_json: Json = False,
) -> None:
    """Estimate how many times likelier ego A fails than ego B, with an interval, from the same scenarios."""
    one_thread()
    from rare_envs.study.compare import compare
    from rare_envs.study.evaluate import Question

    question = Question(
        env_id=env,
        ego=ego_a,
        trust=trust,
        method=method,
        base=base,
        measure=measure,
        gamma=gamma,
        seed=seed,
        max_sim=max_sim,
        noise=noise.argument,
        drivers=drivers,
        observation=observation,
        weather=weather,
        action=action,
        horizon=horizon,
        collisions=collisions,
    )
    with contextlib.redirect_stdout(sys.stderr):
        found = compare(question, ego_b, progress=True, out=out)
    if as_json:
        print_json(found["json"])
    else:
        notes = "".join(f"\n  note: {note}" for note in found["json"]["notes"])
        print(f"A = {ego_a}, B = {ego_b}, {env}\n{found['comparison']}{notes}")
        if out is not None:
            print(f"Wrote {out}.")
    raise typer.Exit(DOUBTFUL if found["comparison"].warnings else 0)


@app.command("train-ego")
def train_ego_command(
    env: Env,
    algo: Annotated[str, typer.Option(help="Stable-Baselines3 algorithm.")] = "ppo",
    steps: Annotated[int, typer.Option(help="Environment steps to train for.")] = 200_000,
    out: Annotated[Path, typer.Option(help="File to save the ego in.")] = Path("ego.zip"),
    seed: Seed = 0,
    num_envs: Annotated[int, typer.Option(help="Episodes that run side by side.")] = 256,
    base: Base = None,
    drivers: Drivers = None,
    noise: NoiseOption = Noise.ON,
    observation: Observation = "features",
    weather: Weather = False,
    action: Action = "continuous",
    horizon: Horizon = None,
    as_json: Json = False,
) -> None:
    """Train an ego on the batched simulation and save it for `rare-envs estimate --ego`."""
    one_thread()
    from rare_envs.study.cli.train import train

    world = {
        "base": base,
        "drivers": drivers,
        "noise": noise.argument,
        "observation": observation,
        "action": action,
        "horizon": horizon,
        "weather": weather,
    }
    path = train(env, algo=algo, steps=steps, out=out, seed=seed, num_envs=num_envs, **world)
    if as_json:
        print_json({"ego": str(path), "env_id": env, "algo": algo, "steps": steps, "seed": seed, **world})
    else:
        words = {**world, "noise": noise.value, "weather": None}
        usual = {"noise": Noise.ON.value, "observation": "features", "action": "continuous"}
        told = [f" --{name} {word}" for name, word in words.items() if word not in (None, usual.get(name))]
        told += [" --weather"] * weather
        print(f"Saved {path}. Next: rare-envs estimate {env} --ego {path}{''.join(told)}")


@app.command("train-drivers")
def train_drivers_command(
    out: Annotated[Path, typer.Option(help="Folder; a training that was stopped in it is taken up.")],
    data: Annotated[Path | None, typer.Option(help="Folder with the compact tables of US 101.")] = None,
    ngsim: Annotated[Path | None, typer.Option(help="Or a raw NGSIM file, CSV or text.")] = None,
    highd: Annotated[Path | None, typer.Option(help="Or a folder with highD's files.")] = None,
    method: Annotated[str, typer.Option(help="bc, gail or mgail.")] = "mgail",
    updates: Annotated[int | None, typer.Option(help="Updates of the policy.")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Train background drivers from recorded traffic; `python -m training.imitation.train` has every setting."""
    one_thread()
    from rare_envs.study.cli.train import train_drivers

    path = train_drivers(data=data, ngsim=ngsim, highd=highd, method=method, seed=seed, updates=updates, out=out)
    if as_json:
        print_json({"driver": str(path), "method": method, "seed": seed})
    else:
        print(f"Saved {path}. Load it with agents.load_driver({str(path)!r}).")


@app.command("export-ego")
def export_ego_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A .zip saved by Stable-Baselines3.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The .onnx file to write.")],
    algo: Algo = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Write a saved policy as ONNX, normalisation, memory and clipping included, and check that both act alike."""
    from rare_envs.study.cli.export_ego import export_ego

    with contextlib.redirect_stdout(sys.stderr):
        done = export_ego(model, out, algo=algo, trust=trust)
    if as_json:
        print_json(done)
    else:
        print(
            f"Wrote {out}: its actions differ by {done['largest_difference']:.1e} at most "
            f"on {done['observations_tried']:,} random observations."
        )


@app.command("replay")
def replay_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that rare-envs estimate --out has written.")],
    failure: Annotated[int, typer.Option(help="Which failure; 0 is the most likely.")] = 0,
    out: Annotated[Path | None, typer.Option(help="A .gif of the drive, or a .png of its worst moment.")] = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Drive a failure that a run has found again, and show it with its measure over time."""
    one_thread()
    from rare_envs.study import video as film

    if out is not None:
        film.check_film(out)
    with contextlib.redirect_stdout(sys.stderr):
        found = film.find(run, failure, trust)
        drive = film.drive_again(found.problem, found.x)
        if out is not None:
            film.write_film(out, drive)
    same = abs(drive.f - found.f) <= film.SAME
    answer = {
        "failure": failure,
        "failures": found.of,
        "f": drive.f,
        "f_recorded": found.f,
        "same": same,
        "log_p0": found.log_p0,
        "seconds": drive.time(len(drive.episodes) - 1),
        "crash": drive.crash,
        "out": None if out is None else str(out),
    }
    if as_json:
        print_json(answer)
    else:
        print("\n".join(film.in_words(found, drive, failure)))
        if out is not None:
            print(f"Wrote {out}.")
    raise typer.Exit(0 if same else DOUBTFUL)


@app.command("check-ego")
def check_ego_command(
    ego: Ego,
    env: Env,
    algo: Algo = None,
    trust: Trust = False,
    observation: Shown = None,
    action: Action = "continuous",
    base: Base = None,
    drivers: Drivers = None,
    horizon: Horizon = None,
    time_limit: Annotated[float, typer.Option(help="Seconds that one check may take.")] = 30.0,
    as_json: Json = False,
) -> None:
    """Look, in seconds, whether an ego fits: spaces, normalisation, determinism, memory, speed. 2: it does not."""
    from dataclasses import asdict

    from rare_envs.study.ego_check.findings import exit_code
    from rare_envs.study.ego_check.subprocess_check import EgoCheckRequest, check_ego
    from rare_envs.study.ego_check.table import VERDICTS, print_findings

    findings = check_ego(
        EgoCheckRequest(
            ego, env, algo, trust, observation, action, time_limit, base=base, drivers=drivers, horizon=horizon
        )
    )
    code = exit_code(findings)
    if as_json:
        print_json(
            {"ego": ego, "env_id": env, "verdict": VERDICTS[code], "findings": [asdict(each) for each in findings]}
        )
    else:
        print_findings(findings, f"{ego} in {env}")
    raise typer.Exit(code)


@app.command("serve-ego")
def serve_ego_command(
    ego: Ego,
    bind: Annotated[
        str, typer.Option(help="Address; beyond 127.0.0.1 it needs RARE_ENVS_SECRET.")
    ] = "tcp://127.0.0.1:5555",
    algo: Algo = None,
    trust: Trust = False,
) -> None:
    """Lend an ego to simulations in other processes or on other machines (estimate --ego tcp://...)."""
    one_thread()
    from rare_envs.study.cli.serve_ego import serve_ego

    serve_ego(ego, bind, algo=algo, trust=trust)


def main() -> None:
    """Run the command line; alone, it shows its help."""
    app(sys.argv[1:] or ["--help"], prog_name="rare-envs")


if __name__ == "__main__":
    main()
