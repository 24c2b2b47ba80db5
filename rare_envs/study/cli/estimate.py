"""Commands that estimate: `estimate`, `resume`, `risk`, `compare` and `plan`."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from rare_envs.scenarios.registry import find_scenario, is_highway_env_id
from rare_envs.study.arguments import (
    GATE_CODES,
    BadInput,
    ExecutorOptions,
    Question,
    as_bad_input,
    find_method,
    read_mapping,
    read_question_file,
)
from rare_envs.study.cli import shell
from rare_envs.study.cli.shell import DOUBTFUL, Answer, command, describe_report, option_of

if TYPE_CHECKING:
    from samplers import Estimate
    from samplers.executors import Executor

NOTHING_MADE = "Stopped: no estimate yet, no simulation made."
"""What is known of a run that was interrupted before it has begun."""
OPTIONS = frozenset(
    "env env_id ego algo stats trust method measure gamma seed max_sim target_cov replicates on_error noise horizon "
    "chunk workers executor address time_limit memory_limit config env_config out force details as_json".split()
)
"""Options, typed or of a file, that HighwayEnv's environments have; the others are of the batched simulation."""
ESTIMATE_FILE = "estimate.safetensors"
"""File in the folder of `--out`; `samplers.Estimate.load` reads it."""
HELD = "HighwayEnv's environment as it is: what it holds fixed is held; rare_envs.highway_env_problem varies it too"
"""Condition of p."""


@command(*shell.EVERYTHING, stopped=NOTHING_MADE)
def estimate_command(
    asked: dict[str, Any],
    places: dict[str, Any],
    typed: set[str],
    env: Annotated[
        str | None, Argument(metavar="ENV", help="Environment, such as rare_envs/CutIn-v0; or in --config.")
    ] = None,
    config: Annotated[
        Path | None, Option(help="YAML file with ENV (env: ...) and options; those given here come first.")
    ] = None,
    env_config: Annotated[
        Path | None, Option(help="JSON or YAML file of HighwayEnv's config, such as the ego's observation there.")
    ] = None,
    out: Annotated[Path | None, Option(help="Folder of the run: result.json, episodes.parquet and more.")] = None,
    force: shell.ForceOption = False,
    details: shell.DetailsOption = False,
) -> Answer:
    """Estimate how often an ego fails, with an interval, and show its most likely failure."""
    given = {} if config is None else read_question_file(config)
    chosen = {**asked, **places, **given, **{name: (asked | places)[name] for name in typed & {*asked, *places}}}
    of_executor = {name: chosen.pop(name) for name in places}
    chosen |= {} if env is None else {"env_id": env}
    if "env_id" not in chosen:
        raise BadInput("Expected an environment: rare-envs estimate ENV, or env: ENV in the file of --config.")
    question = Question(**chosen)
    if not question.has_limit:
        refuse_without_limit(typed | set(given), "--max-p or --max-rate")
    with as_bad_input(ValueError):
        executor = ExecutorOptions(**of_executor).make()
    if is_highway_env_id(question.env_id):
        refused = sorted((typed | set(given)) - OPTIONS)
        if refused:
            import rare_envs

            raise BadInput(
                f"{question.env_id!r} is an environment of HighwayEnv, which has no --{refused[0].replace('_', '-')}; "
                f"expected {', '.join(rare_envs.ENV_IDS)} with it."
            )
        env_settings = None if env_config is None else read_mapping(env_config)
        return estimate_highway_env(question, env_settings, out, force, details, executor)
    if env_config is not None:
        raise BadInput(f"Expected --env-config with an environment of HighwayEnv, such as highway-fast-v0, got {env}.")

    from rare_envs.study.evaluate import run, run_into
    from rare_envs.study.question import prepare

    estimate = run if out is None else partial(run_into, out, force=force)
    return describe_report(estimate(prepare(question), progress=True, executor=executor), out, details)


def refuse_without_limit(typed: set[str], limits: str) -> None:
    """Raise a BadInput that names an option about a limit, where there is none."""
    for name, option in (("assume_traffic", "--assume-traffic"), ("gate_confidence", "--confidence")):
        if name in typed:
            raise BadInput(f"Expected {option} together with {limits}, the limit.")


def _split_words(*texts: str) -> list[str]:
    """Return the words of texts in which commas stand between words."""
    return [word.strip() for text in texts for word in text.split(",") if word.strip()]


def format_seconds(seconds: float) -> str:
    """Return a time in a unit of its size."""
    if seconds < 7200.0:
        size, unit = (1.0, "s") if seconds < 120.0 else (60.0, "min")
        return f"{max(1, math.ceil(seconds / size))} {unit}"
    return f"{seconds / 3600:,.0f} h"


def estimate_highway_env(
    question: Question,
    config: dict[str, Any] | None,
    out: Path | None,
    force: bool,
    details: bool,
    executor: Executor | None,
) -> Answer:
    """Estimate how often an ego crashes in one of HighwayEnv's environments, as that environment draws its traffic."""
    import agents
    import rare_envs
    import samplers
    from rare_envs.study import writing
    from rare_envs.study.arguments import FIRST_BATCH, RunInterrupted, describe_stop

    vehicles = str((config or {}).get("other_vehicles_type", "highway_env."))
    if not vehicles.startswith("highway_env.") and not question.trust:
        raise BadInput(f"The file of --env-config names code, {vehicles!r}: let it run by --trust.")
    file = None if out is None else out / ESTIMATE_FILE
    if file is not None and file.exists() and not force:
        raise BadInput(f"There is a finished run in {str(out)!r} ({ESTIMATE_FILE}): replace it by --force.")
    names = ("gamma", "seed", "max_sim", "target_cov", "replicates", "on_error")
    with as_bad_input(ValueError, OSError, TypeError):
        method = find_method(question.method)
        arguments = {name: getattr(question.run_arguments, name) for name in names}
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        settings: dict[str, Any] = {"config": config}
        settings |= {} if question.horizon is None else {"horizon": question.horizon}
        problem = rare_envs.highway_env_problem(
            question.env_id, ego, measure=question.measure, noise=question.noise, fixed="highway_env", **settings
        )
    command = f"estimate --env-config {json.dumps(config, sort_keys=True)}" if config else "estimate"
    with writing.journals_of(command, out, {"": question}, force, ESTIMATE_FILE) as (journal,):
        with as_bad_input(ValueError, OSError, TypeError):
            arguments["journal"] = journal
            try:
                result = samplers.estimate(problem, method, progress=True, executor=executor, **arguments)
            except samplers.EstimationInterrupted as stopped:
                known = _describe(question, problem, stopped.estimate, None, details)
                raise RunInterrupted(describe_stop(stopped.estimate), known) from None
            except KeyboardInterrupt:
                raise RunInterrupted(FIRST_BATCH) from None
        if file is not None:
            with writing.unwritten_results(file.parent, _describe(question, problem, result, None, details)):
                result.save(file)
    return _describe(question, problem, result, out, details)


def _describe(question: Question, problem: Any, result: Estimate, out: Path | None, details: bool) -> Answer:
    """Return the answer of an estimate in an environment of HighwayEnv."""
    import numpy as np

    from rare_envs.study.report import has_exact_bound
    from samplers.output import MOST_LINES, fold_rows
    from samplers.result import list_facts, list_warnings

    shown = result
    if has_exact_bound(result):  # the warning that nothing failed casts no doubt on the upper end
        shown = replace(result, warnings=(), remarks=(*result.warnings, *result.remarks))
    facts, likeliest = [*list_facts(result), ("Given", HELD)], {}
    if len(result.failures):
        named = problem.space.named(result.failures.x[0].round(3))
        likeliest = {name: np.asarray(value).tolist() for name, value in named.items()}
        facts.append(("Failure", f"most likely: {', '.join(f'{name} {value}' for name, value in likeliest.items())}"))
    facts += [*list_warnings(shown.warnings), *([("Wrote", str(out))] if out else [])]
    lines = [f"{question.ego} in {question.env_id}", *fold_rows(facts, MOST_LINES - 1)]
    lines += shown.details().splitlines() if details else []
    about = {"env_id": question.env_id, "ego": question.ego, "given": HELD, "most_likely": likeliest}
    about["env_config"] = problem.config
    data = {**result.to_dict(), **about, "doubtful": bool(shown.warnings)}
    return Answer(data, "\n".join(lines), DOUBTFUL if shown.warnings else 0)


@command("trust", stopped="Stopped before the run went on; what it had kept is still there.")
def resume_command(
    run: Annotated[Path, Argument(metavar="RUN", help="Folder of an estimate --out that has not come to its end.")],
    asked: dict[str, Any],
    places: dict[str, Any],
    ego: Annotated[str | None, Option(help="New address of an ego in another program, tcp://...")] = None,
    on_error: Annotated[str | None, Option(help="Instead of what the run had: raise, failure or bound.")] = None,
    mend: Annotated[
        bool, Option("--mend", help="Of a damaged journal, keep the simulations before the damage.")
    ] = False,
    details: shell.DetailsOption = False,
) -> Answer:
    """Continue an interrupted run; the result is the same as without the interruption."""
    from rare_envs.study.evaluate import resume

    with as_bad_input(ValueError):
        executor = ExecutorOptions(**places).make()
    report = resume(run, ego, on_error, progress=True, mend=mend, executor=executor, **asked)
    return describe_report(report, run, details)


@command(*shell.ASKED)
def plan_command(
    target: Annotated[
        str, Argument(metavar="ENV|RUN", help="Environment, of which pilots are run; or the folder of a run.")
    ],
    asked: dict[str, Any],
    typed: set[str],
    cov: Annotated[float, Option("--cov", "--target-cov", help="Coefficient of variation that is wished for.")] = 0.1,
    ego: Annotated[str, Option(help="An ego, as for estimate --ego.")] = "idm",
    pilot: Annotated[
        int | None, Option(help="Simulations of each pilot.", show_default="the method's own budget")
    ] = None,
) -> Answer:
    """Plan simulations and wall time for a precision, by each of --method (joined by commas) and plain Monte Carlo."""
    from rare_envs.study.evaluate import plan_by_pilots, plan_from_result
    from rare_envs.study.run_folder import load_finished
    from samplers.problem import check_number

    with as_bad_input(ValueError):
        check_number("--cov", cov, 0.0, math.inf)  # before the pilots
    if Path(target).is_dir():
        refused = sorted(typed - {"target", "cov", "as_json"})
        if refused:
            option = refused[0].replace("_", "-")
            raise BadInput(f"Expected the folder of a run without --{option}: nothing is simulated.")
        found = plan_from_result(load_finished(Path(target)).result, cov)
    else:
        try:
            find_scenario(target)
        except ValueError as error:
            raise BadInput(f"There is no folder {target!r} of a run. {error}") from error
        methods = _split_words(asked.pop("method"))
        question = Question(env_id=target, ego=ego, max_sim=pilot, **asked)
        found = plan_by_pilots(question, methods, cov, progress=True)
    lines = [f"For a c.o.v. of {cov:g} (--target-cov {cov:g}):"]
    for each in found:
        time = "" if each.seconds is None else f", about {format_seconds(each.seconds)} at the pilot's speed"
        lines.append(f"  {each.method:<12} {each.n_sim:>15,} simulations{time}")
    return Answer({"target_cov": cov, "runs": [each.to_dict() for each in found]}, "\n".join(lines))


@command(
    *("method", "ensemble_run", "device", "seed", *shell.EGO_FILE, "trust", "observation", "action"),
    *("max_rate", "gate_confidence", "assume_traffic"),
    stopped=NOTHING_MADE,
)
def risk_command(
    ego: shell.EgoArgument,
    asked: dict[str, Any],
    typed: set[str],
    scenario: Annotated[
        list[str] | None,
        Option(help="Scenario of the sum; several with commas.", show_default="cut_in and hard_brake"),
    ] = None,
    sites: Annotated[
        str,
        Option(help="Site of the bases, us101 or i80; both, joined by a comma, for the spread between sites."),
    ] = "us101",
    base: Annotated[
        list[str] | None, Option(help="SCENARIO=NAME or FILE, in place of the site's base; may be repeated.")
    ] = None,
    max_sim: Annotated[int | None, option_of("max_sim", help="Largest number of simulations of each scenario.")] = None,
    out: Annotated[Path | None, Option(help="Folder for risk.json, risk.png and a run of each scenario.")] = None,
    force: shell.ForceOption = False,
    details: shell.DetailsOption = False,
) -> Answer:
    """Estimate collisions per million km, summed over scenarios, with an interval."""
    from rare_envs.study.risk import SCENARIO_SET, Risk, risk
    from rare_envs.study.text import list_gate

    if asked["max_rate"] is None:
        refuse_without_limit(typed, "--max-rate")
    bases: dict[str, str] = {}
    for owner, _, name in (word.partition("=") for word in base or []):
        if not owner or not name:
            raise BadInput(f"Expected --base SCENARIO=NAME, such as cut_in=i80, got {owner!r} alone.")
        if owner in bases:
            raise BadInput(f"Expected one --base for each scenario, got several for {owner!r}.")
        bases[owner] = name

    def tell(found: Any, *wrote: tuple[str, str]) -> Answer:
        code = DOUBTFUL if found.warnings else 0
        code = code if found.verdict is None else GATE_CODES[found.verdict.decision]
        lines, gate = found.describe(wrote), list_gate(found.verdict)
        lines[len(lines) - len(gate) :] = [*([found.details()] if details else []), *gate]
        return Answer(found.to_dict(), "\n".join(lines), code)

    with as_bad_input(ValueError), shell.telling_unwritten(Risk, tell):
        found = risk(
            ego,
            scenarios=_split_words(*scenario or ()) or SCENARIO_SET,
            sites=_split_words(sites),
            bases=bases,
            out=out,
            progress=True,
            force=force,
            max_sim=max_sim,
            **asked,
        )
    return tell(found, *([] if out is None else [("Wrote", str(out))]))


@command(*shell.ASKED, stopped=NOTHING_MADE)
def compare_command(
    ego_a: Annotated[str, Argument(metavar="EGO_A", help="An ego, as for estimate --ego.")],
    ego_b: Annotated[str, Argument(metavar="EGO_B", help="The other ego.")],
    env: shell.EnvArgument,
    asked: dict[str, Any],
    max_sim: Annotated[
        int, option_of("max_sim", help="Largest number of simulations, of both egos together.", show_default=True)
    ] = 12_000,
    algo_b: Annotated[str | None, Option(help="As --algo, for the .zip of EGO_B.")] = None,
    stats_b: Annotated[str | None, Option(help="As --stats, for the .zip of EGO_B.")] = None,
    out: Annotated[Path | None, Option(help="Folder for comparison.json and failures.csv.")] = None,
    force: shell.ForceOption = False,
) -> Answer:
    """Estimate how many times likelier ego A fails than ego B, with an interval, from the same scenarios."""
    from rare_envs.study.evaluate import compare_egos

    question = Question(env_id=env, ego=ego_a, max_sim=max_sim, **asked)

    def tell(pair: Any, *wrote: str) -> Answer:
        found, answer = pair
        lines = [f"A = {ego_a}, B = {ego_b}, {env}", str(found), *(f"  note: {note}" for note in answer["notes"])]
        return Answer(answer, "\n".join([*lines, *wrote]), DOUBTFUL if found.warnings else 0)

    b: dict[str, Any] = {"algo_b": algo_b, "stats_b": stats_b}
    with shell.telling_unwritten(tuple, tell):
        pair = compare_egos(question, ego_b, progress=True, out=out, force=force, **b)
    return tell(pair, *([] if out is None else [f"Wrote {out}."]))
