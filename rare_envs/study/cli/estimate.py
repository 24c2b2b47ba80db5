"""Commands that estimate: `estimate`, `risk`, `compare` and `resume`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from rare_envs.scenarios.registry import SCENARIOS, complete_id, find_scenario, is_highway_env_id
from rare_envs.study.arguments import BadInput, Question, as_bad_input, find_method, read_mapping
from rare_envs.study.cli import options
from rare_envs.study.cli.options import command
from rare_envs.study.cli.shell import DOUBTFUL, EXECUTOR, Answer, tell

if TYPE_CHECKING:
    from samplers import Estimate

NOTHING_MADE = "Stopped: no estimate yet, no simulation made."
"""What is known of a run that was interrupted before it has begun."""
OPTIONS = frozenset(
    "env env_id ego algo stats trust method measure gamma seed max_sim target_cov confidence replicates on_error noise "
    "horizon chunk workers executor address time_limit memory_limit config env_config out force details as_json".split()
)
"""Options, typed or of a file, that HighwayEnv's environments have; the others are of the batched simulation."""
PLANNED = frozenset({"env", "config", "plan", "target_cov", "as_json", "trust"})
"""Options of a plan from the folder of a run, in which nothing is simulated."""
UNPLANNED = frozenset({"out", "force", "details", "max_p", "max_rate", "assume_traffic", "workers", "env_config"})
"""Options that a plan by pilots does not use."""
PAIR_SIMULATIONS = 12_000
"""Simulations of both egos of a comparison together."""
ESTIMATE_FILE = "estimate.safetensors"
"""File in the folder of `--out`; `samplers.Estimate.load` reads it."""
HELD = "HighwayEnv's environment as it is: what it holds fixed is held; rare_envs.highway_env_problem varies it too"
"""Condition of p."""


@command(
    *("ego", *options.SCENARIO, "measure", "gamma", "method", "max_sim", "target_cov", "confidence", "seed"),
    *("max_p", "max_rate", "assume_traffic", "workers", "trust"),
    more=(
        *("env_id", *options.WORLD_IN_FILES, *options.RUN_IN_FILES),
        *("replicates", "on_error", "ensemble", "also_under", "sensitivity"),
    ),
    texts=("env_config",),
    stopped=NOTHING_MADE,
)
def estimate_command(
    asked: dict[str, Any],
    typed: set[str],
    executor: Any,
    env: Annotated[
        str | None,
        Argument(
            metavar="SCENARIO",
            help="Scenario: CutIn, cut-in and rare_envs/CutIn-v1 are the same; or a folder of a run, with --plan.",
        ),
    ] = None,
    plan: Annotated[
        bool,
        Option("--plan", help="Print the simulations and the time that --target-cov needs, from pilots of --max-sim."),
    ] = False,
    env_config: str | None = None,
    out: Annotated[Path | None, Option(help="Folder of the run: result.json, episodes.parquet and more.")] = None,
    force: options.ForceOption = False,
    details: options.DetailsOption = False,
) -> Answer:
    """Estimate how often an ego fails in a scenario, with an interval, and show its most likely failure."""
    if env is None:
        raise BadInput("Expected a scenario: rare-envs estimate CutIn, or env: CutIn in the file of --config.")
    if plan:
        return _plan(env, asked, typed)
    if Path(env).is_dir():
        raise BadInput(f"{env!r} is a folder: rare-envs resume {env}, rare-envs report {env}, or --plan with it.")
    question = _ask(env, asked)
    if is_highway_env_id(question.env_id):
        refused = sorted(typed - OPTIONS)
        if refused:
            import rare_envs

            raise BadInput(
                f"{question.env_id!r} is an environment of HighwayEnv, which has no --{refused[0].replace('_', '-')}; "
                f"expected {', '.join(rare_envs.ENV_IDS)} with it."
            )
        env_settings = None if env_config is None else read_mapping(Path(env_config))
        return estimate_highway_env(question, env_settings, out, force, details, executor)
    if env_config is not None:
        raise BadInput(f"Expected env_config with an environment of HighwayEnv, such as highway-fast-v0, got {env}.")

    from rare_envs.study.evaluate import run, run_into
    from rare_envs.study.question import prepare

    estimate = run if out is None else partial(run_into, out, force=force)
    return tell(estimate(prepare(question), progress=True, executor=executor), out, details)


def _ask(env: str, asked: Mapping[str, Any]) -> Question:
    """Return the question in a scenario that options ask for."""
    base = asked.get("base")
    if base and not is_highway_env_id(env):
        base = _read_bases([base], [env]).get(env)
    with as_bad_input(ValueError):
        question = Question(**{**asked, "base": base, "env_id": complete_id(env)})
        _ = question.run_arguments
    return question


def _read_bases(words: Sequence[str], scenarios: Sequence[str]) -> dict[str, str]:
    """Return the traffic model of each scenario that has one: NAME or FILE is for all, SCENARIO=NAME for one."""
    found: dict[str, str] = {}
    with as_bad_input(ValueError):
        for word in words:
            owner, equals, name = word.partition("=")
            mine = [*scenarios]
            if not equals or Path(word).is_file():
                name = word
            elif not (mine := [each for each in scenarios if find_scenario(each) is find_scenario(owner)]):
                raise BadInput(f"--base {word} is of {owner}, which is none of {', '.join(scenarios)}.")
            if not name:
                raise BadInput(f"Expected --base NAME or SCENARIO=NAME, such as cut_in=i80, got {word!r}.")
            if twice := next((each for each in mine if each in found), ""):
                raise BadInput(f"Expected one --base for each scenario, got several for {twice!r}.")
            found |= dict.fromkeys(mine, name)
    return found


def estimate_highway_env(
    question: Question,
    config: dict[str, Any] | None,
    out: Path | None,
    force: bool,
    details: bool,
    executor: Any,
) -> Answer:
    """Estimate how often an ego crashes in one of HighwayEnv's environments, as that environment draws its traffic."""
    import agents
    import rare_envs
    import samplers
    from rare_envs.study import writing
    from rare_envs.study.arguments import FIRST_BATCH, RunInterrupted, describe_stop

    vehicles = str((config or {}).get("other_vehicles_type", "highway_env."))
    if not vehicles.startswith("highway_env.") and not question.trust:
        raise BadInput(f"The file of env_config names code, {vehicles!r}: let it run by --trust.")
    file = None if out is None else out / ESTIMATE_FILE
    with as_bad_input(ValueError, OSError, TypeError):
        method, arguments = find_method(question.method), asdict(question.run_arguments)
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        settings: dict[str, Any] = {"config": config}
        settings |= {} if question.horizon is None else {"horizon": question.horizon}
        problem = rare_envs.highway_env_problem(
            question.env_id, ego, measure=question.measure, noise=question.noise, fixed="highway_env", **settings
        )
    whole = {"command": "estimate", "env_config": config}
    with writing.journals_of(whole, out, {"": question}, force, ESTIMATE_FILE) as (journal,):
        with as_bad_input(ValueError, OSError, TypeError):
            arguments |= {"journal": journal, "executor": executor, "progress": True}
            try:
                result = samplers.estimate(problem, method, **arguments)
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

    shown, likeliest = result, dict[str, Any]()
    if has_exact_bound(result):  # the warning that nothing failed casts no doubt on the upper end
        shown = replace(result, warnings=(), remarks=(*result.warnings, *result.remarks))
    facts = [*list_facts(result), ("Given", HELD)]
    if len(result.failures):
        named = problem.space.named(result.failures.x[0].round(3))
        likeliest = {name: np.asarray(value).tolist() for name, value in named.items()}
        facts.append(("Failure", f"most likely: {', '.join(f'{name} {value}' for name, value in likeliest.items())}"))
    facts += [*list_warnings(shown.warnings), *([("Wrote", str(out))] if out else [])]
    lines = [f"{question.ego} in {question.env_id}", *fold_rows(facts, MOST_LINES - 1)]
    lines += shown.details().splitlines() if details else []
    about: dict[str, Any] = {"env_id": question.env_id, "ego": question.ego, "given": HELD, "most_likely": likeliest}
    about |= {"env_config": problem.config, "doubtful": bool(shown.warnings)}
    return Answer({**result.to_dict(), **about}, "\n".join(lines), DOUBTFUL if shown.warnings else 0)


def _plan(target: str, asked: dict[str, Any], typed: set[str]) -> Answer:
    """Return simulations and time for a precision, by each of --method (joined by commas) and plain Monte Carlo."""
    from rare_envs.study.evaluate import plan_by_pilots, plan_from_result
    from rare_envs.study.run_folder import load_finished
    from samplers.problem import check_number

    cov = 0.1 if asked["target_cov"] is None else asked["target_cov"]
    with as_bad_input(ValueError):
        check_number("--target-cov", cov, 0.0, math.inf)  # before the pilots
    folder = Path(target).is_dir()
    refused = sorted(typed - PLANNED if folder else typed & UNPLANNED)
    if refused:
        why = "the folder of a run without it: nothing is simulated" if folder else "--plan without it"
        raise BadInput(f"--{refused[0].replace('_', '-')} has no use here. Expected {why}.")
    if folder:
        found = plan_from_result(load_finished(Path(target)), cov, asked["trust"])
    else:
        try:
            find_scenario(target)
        except ValueError as error:
            raise BadInput(f"There is no folder {target!r} of a run. {error}") from error
        methods = options.split_words([asked.pop("method")])
        found = plan_by_pilots(_ask(target, {**asked, "target_cov": None}), methods, cov, progress=True)
    lines = [f"For a relative error of {100 * cov:g} % (--target-cov {cov:g}):"]
    for each in found:
        time = "" if each.seconds is None else f", about {_format_seconds(each.seconds)} at the pilot's speed"
        lines.append(f"  {each.method:<12} {each.n_sim:>15,} simulations{time}")
    return Answer({"target_cov": cov, "runs": [each.to_dict() for each in found]}, "\n".join(lines))


def _format_seconds(seconds: float) -> str:
    """Return a time in a unit of its size."""
    if seconds < 7200.0:
        size, unit = (1.0, "s") if seconds < 120.0 else (60.0, "min")
        return f"{max(1, math.ceil(seconds / size))} {unit}"
    return f"{seconds / 3600:,.0f} h"


@command(
    *("drivers", "observation", "action", "method", "max_sim", "target_cov", "confidence", "seed"),
    *("max_rate", "assume_traffic", "workers", "trust"),
    more=(*options.WORLD_IN_FILES, *options.RUN_IN_FILES, "replicates", "on_error"),
    texts=("scenario", "sites", "base"),
    stopped=NOTHING_MADE,
    max_sim={"help": "Largest number of simulations of each scenario."},
)
def risk_command(
    ego: options.EgoArgument,
    asked: dict[str, Any],
    executor: Any,
    scenario: Annotated[
        list[str] | None,
        Option(help="Scenarios of the sum, joined by commas: CutIn,HardBrake.", show_default="CutIn,HardBrake"),
    ] = None,
    base: Annotated[
        list[str] | None,
        Option(help="Traffic model: NAME or FILE for all scenarios, or SCENARIO=NAME or FILE; may be repeated."),
    ] = None,
    sites: Annotated[
        str, Option(help="Sites of the traffic models, joined by commas; several add the spread between them.")
    ] = "us101",
    out: Annotated[Path | None, Option(help="Folder for risk.json, risk.png and a run of each scenario.")] = None,
    force: options.ForceOption = False,
    details: options.DetailsOption = False,
) -> Answer:
    """Estimate collisions per million km, summed over scenarios, with an interval."""
    from rare_envs.study.risk import SCENARIO_SET, risk

    scenarios = options.split_words(scenario) or [*SCENARIO_SET]
    bases = _read_bases(base or (), scenarios)
    with as_bad_input(ValueError):
        _ = Question(env_id=scenarios[0], **asked).run_arguments
        of_sum: dict[str, Any] = {"scenarios": scenarios, "sites": options.split_words([sites]), "bases": bases}
        found = risk(ego, out=out, progress=True, force=force, executor=executor, **of_sum, **asked)
    return tell(found, out, details)


@command(
    *(*options.SCENARIO, "measure", "gamma", "method", "max_sim", "confidence", "seed"),
    *("max_ratio", "assume_traffic", "workers", "trust"),
    more=("env_id", *options.WORLD_IN_FILES, *options.RUN_IN_FILES),
    texts=("algo_b", "stats_b"),
    stopped=NOTHING_MADE,
    max_sim={"help": "Largest number in each scenario, of both egos together.", "show_default": "12,000"},
)
def compare_command(
    ego_a: Annotated[str, Argument(metavar="EGO_A", help="Policy A, the one before, as for estimate --ego.")],
    ego_b: Annotated[str, Argument(metavar="EGO_B", help="Policy B, the new one.")],
    asked: dict[str, Any],
    executor: Any,
    env: Annotated[str | None, Argument(metavar="SCENARIO", help="Scenario; those of risk by default.")] = None,
    algo_b: str | None = None,
    stats_b: str | None = None,
    out: Annotated[Path | None, Option(help="Folder for comparison.json and failures.csv.")] = None,
    force: options.ForceOption = False,
    details: options.DetailsOption = False,
) -> Answer:
    """Estimate how many times likelier ego A fails than ego B, in a scenario or summed over those of risk."""
    if scenario := next((name for name in (ego_a, ego_b) if complete_id(name) in SCENARIOS), ""):
        raise BadInput(
            f"Expected two egos before the scenario {scenario}: rare-envs compare old.zip new.zip {scenario}."
        )
    how: dict[str, Any] = {"out": out, "progress": True, "force": force, "executor": executor}
    how |= {"algo_b": algo_b, "stats_b": stats_b}
    asked["max_sim"] = asked["max_sim"] or PAIR_SIMULATIONS
    if env is not None:
        from rare_envs.study.comparison import compare_egos

        return tell(compare_egos(_ask(env, {**asked, "ego": ego_a}), ego_b, **how), out, details)
    from rare_envs.study.compared_risks import compare_risks
    from rare_envs.study.risk import SCENARIO_SET

    base = asked.pop("base")
    with as_bad_input(ValueError):
        bases = _read_bases([base] if base else [], SCENARIO_SET)
        return tell(compare_risks(ego_a, ego_b, bases=bases, **how, **asked), out, details)


@command(*EXECUTOR, "trust", stopped="Stopped before the run went on; what it had kept is still there.")
def resume_command(
    run: Annotated[Path, Argument(metavar="RUN", help="Folder of --out of an interrupted estimate, risk or compare.")],
    asked: dict[str, Any],
    executor: Any,
    ego: Annotated[str | None, Option(help="New address of an ego in another program, tcp://HOST:PORT.")] = None,
    on_error: Annotated[str | None, Option(help="New value of on_error: raise, failure or bound.")] = None,
    mend: Annotated[
        bool, Option("--mend", help="Keep the simulations before the damage of a damaged journal.")
    ] = False,
    details: options.DetailsOption = False,
) -> Answer:
    """Continue an interrupted estimate, risk or compare; the result is the same as without the interruption."""
    from rare_envs.study import compared_risks, comparison, evaluate, writing

    trust = asked["trust"]
    folder, whole, questions = writing.find_whole(run, mend)
    command = whole.get("command", "")
    if wrong := ("--ego" if whole and ego else "--on-error" if on_error and command not in ("", "risk") else ""):
        first = "start the ego again at the address that it had, and " if ego else ""
        raise BadInput(
            f"{wrong} is for a run of one scenario{'' if ego else ', or a risk'}, and {str(run)!r} is of {command}: "
            f"{first}resume it without, or begin again with --force."
        )
    if not whole:
        return tell(evaluate.resume(run, ego, on_error, trust, progress=True, executor=executor), run, details)
    if command == "estimate":
        from rare_envs.study.question import open_question

        (question,) = questions.values()
        opened = open_question(asdict(question), folder, trust, core=question.core, device=question.device)
        return estimate_highway_env(opened, whole["env_config"], folder, False, details, executor)
    if command == "compare":
        return tell(comparison.resume_comparison(folder, questions, trust, executor), folder, details)
    with as_bad_input(ValueError):
        return tell(compared_risks.resume_sum(folder, questions, whole, trust, executor, on_error), folder, details)
