"""Commands that estimate: `estimate`, `risk`, `compare` and `resume`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
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
)
from rare_envs.study.cli import shell
from rare_envs.study.cli.shell import DOUBTFUL, Answer, command, describe_report

if TYPE_CHECKING:
    from rare_envs.study.risk import Risk, RiskComparison
    from samplers import Estimate
    from samplers.comparison import Comparison
    from samplers.executors import Executor

NOTHING_MADE = "Stopped: no estimate yet, no simulation made."
"""What is known of a run that was interrupted before it has begun."""
OPTIONS = frozenset(
    "env env_id ego algo stats trust method measure gamma seed max_sim target_cov confidence replicates on_error noise "
    "horizon chunk workers executor address time_limit memory_limit config env_config out force details as_json".split()
)
"""Options, typed or of a file, that HighwayEnv's environments have; the others are of the batched simulation."""
PLANNED = frozenset({"env", "config", "plan", "target_cov", "as_json"})
"""Options of a plan from the folder of a run, in which nothing is simulated."""
UNPLANNED = frozenset({"out", "force", "details", "max_p", "max_rate", "assume_traffic", "workers", "env_config"})
"""Options that a plan by pilots does not use."""
PAIR_SIMULATIONS = 12_000
"""Simulations of both egos of a comparison together."""
REPORTED = ("also_under", "sensitivity")
"""Fields that add to the answer of an estimate."""
PLANNED = frozenset({"env", "config", "plan", "target_cov", "as_json"})
"""Options of a plan from the folder of a run, in which nothing is simulated."""
UNPLANNED = frozenset({"out", "force", "details", "max_p", "max_rate", "assume_traffic", "workers", "env_config"})
"""Options that a plan by pilots does not use."""
ESTIMATE_FILE = "estimate.safetensors"
"""File in the folder of `--out`; `samplers.Estimate.load` reads it."""
HELD = "HighwayEnv's environment as it is: what it holds fixed is held; rare_envs.highway_env_problem varies it too"
"""Condition of p."""


@command(
    *("ego", *shell.SCENARIO, "measure", "gamma", "method", "max_sim", "target_cov", "confidence", "seed"),
    *("max_p", "max_rate", "assume_traffic", "workers", "trust"),
    more=("env_id", *shell.WORLD_IN_FILES, *shell.RUN_IN_FILES, "replicates", "on_error", "ensemble", *REPORTED),
    texts=("env_config",),
    stopped=NOTHING_MADE,
)
def estimate_command(
    asked: dict[str, Any],
    typed: set[str],
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
    force: shell.ForceOption = False,
    details: shell.DetailsOption = False,
) -> Answer:
    """Estimate how often an ego fails in a scenario, with an interval, and show its most likely failure."""
    env = env or asked.pop("env_id")
    if env is None:
        raise BadInput("Expected a scenario: rare-envs estimate CutIn, or env: CutIn in the file of --config.")
    if plan:
        return _plan(env, asked, typed)
    if Path(env).is_dir():
        raise BadInput(f"{env!r} is a folder: rare-envs resume {env}, rare-envs report {env}, or --plan with it.")
    question, executor = _ask(env, asked)
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
    return describe_report(estimate(prepare(question), progress=True, executor=executor), out, details)


def _ask(env: str, asked: Mapping[str, Any], **more: Any) -> tuple[Question, Executor | None]:
    """Return the question in a scenario, and the executor, that options ask for."""
    of_question = {name: value for name, value in asked.items() if name not in (*shell.EXECUTOR, "env_id")}
    of_question |= {**more, "env_id": shell.read_environment(env)}
    if of_question.get("base") and not is_highway_env_id(env):
        of_question["base"] = _read_bases([of_question["base"]], [env]).get(env)
    with as_bad_input(ValueError):
        question = Question(**of_question)
        _ = question.run_arguments
        return question, _make_executor(asked)


def _make_executor(asked: Mapping[str, Any]) -> Executor | None:
    """Return the executor that options ask for."""
    with as_bad_input(ValueError):
        return ExecutorOptions(**{name: asked[name] for name in shell.EXECUTOR}).make()


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
        raise BadInput(f"The file of env_config names code, {vehicles!r}: let it run by --trust.")
    file = None if out is None else out / ESTIMATE_FILE
    if file is not None and file.exists() and not force:
        raise BadInput(f"There is a finished run in {str(out)!r} ({ESTIMATE_FILE}): replace it by --force.")
    names = ("gamma", "seed", "max_sim", "target_cov", "replicates", "on_error", "confidence")
    with as_bad_input(ValueError, OSError, TypeError):
        method = find_method(question.method)
        arguments = {name: getattr(question.run_arguments, name) for name in names}
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        settings: dict[str, Any] = {"config": config}
        settings |= {} if question.horizon is None else {"horizon": question.horizon}
        problem = rare_envs.highway_env_problem(
            question.env_id, ego, measure=question.measure, noise=question.noise, fixed="highway_env", **settings
        )
    with writing.journals_of(
        {"command": "estimate", "env_config": config}, out, {"": question}, force, ESTIMATE_FILE
    ) as (journal,):
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
        found = plan_from_result(load_finished(Path(target)).result, cov)
    else:
        try:
            find_scenario(target)
        except ValueError as error:
            raise BadInput(f"There is no folder {target!r} of a run. {error}") from error
        methods = shell.split_words(asked.pop("method"))
        question, _ = _ask(target, {**asked, "target_cov": None})
        found = plan_by_pilots(question, methods, cov, progress=True)
    lines = [f"For a relative error of {100 * cov:g} % (--target-cov {cov:g}):"]
    for each in found:
        time = "" if each.seconds is None else f", about {format_seconds(each.seconds)} at the pilot's speed"
        lines.append(f"  {each.method:<12} {each.n_sim:>15,} simulations{time}")
    return Answer({"target_cov": cov, "runs": [each.to_dict() for each in found]}, "\n".join(lines))


@command(
    *("drivers", "observation", "action", "method", "max_sim", "target_cov", "confidence", "seed"),
    *("max_rate", "assume_traffic", "workers", "trust"),
    more=(*shell.WORLD_IN_FILES, *shell.RUN_IN_FILES, "replicates", "on_error"),
    texts=("scenario", "sites", "base"),
    stopped=NOTHING_MADE,
    max_sim={"help": "Largest number of simulations of each scenario."},
)
def risk_command(
    ego: shell.EgoArgument,
    asked: dict[str, Any],
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
    force: shell.ForceOption = False,
    details: shell.DetailsOption = False,
) -> Answer:
    """Estimate collisions per million km, summed over scenarios, with an interval."""
    from rare_envs.study.risk import SCENARIO_SET, Risk, risk

    executor, tell = _make_executor(asked), partial(_tell_risk, details)
    scenarios = shell.split_words(*scenario or ()) or [*SCENARIO_SET]
    options = {name: value for name, value in asked.items() if name not in shell.EXECUTOR}
    bases = _read_bases(base or (), scenarios)
    with as_bad_input(ValueError), shell.telling_unwritten(Risk, tell):
        _ = Question(env_id=scenarios[0], **options).run_arguments
        about: dict[str, Any] = {"scenarios": scenarios, "sites": shell.split_words(sites), "bases": bases, **options}
        found = risk(ego, out=out, progress=True, force=force, executor=executor, **about)
    return tell(found, out)


def _tell_risk(details: bool, found: Risk | RiskComparison, out: Path | None = None) -> Answer:
    """Return the answer of a risk, or of the comparison of two."""
    from rare_envs.study.text import list_gate

    code = DOUBTFUL if found.warnings else 0
    code = code if found.verdict is None else GATE_CODES[found.verdict.decision]
    lines, gate = found.describe([] if out is None else [("Wrote", str(out))]), list_gate(found.verdict)
    lines[len(lines) - len(gate) :] = [*([found.details()] if details else []), *gate]
    return Answer(found.to_dict(), "\n".join(lines), code)


@command(
    *(*shell.SCENARIO, "measure", "gamma", "method", "max_sim", "confidence", "seed"),
    *("max_ratio", "assume_traffic", "workers", "trust"),
    more=("env_id", *shell.WORLD_IN_FILES, *shell.RUN_IN_FILES),
    texts=("algo_b", "stats_b"),
    stopped=NOTHING_MADE,
    max_sim={"help": "Largest number of simulations, of both egos together.", "show_default": "12,000"},
)
def compare_command(
    ego_a: Annotated[str, Argument(metavar="EGO_A", help="Policy A, the one before, as for estimate --ego.")],
    ego_b: Annotated[str, Argument(metavar="EGO_B", help="Policy B, the new one.")],
    asked: dict[str, Any],
    env: Annotated[str | None, Argument(metavar="SCENARIO", help="Scenario; those of risk by default.")] = None,
    algo_b: str | None = None,
    stats_b: str | None = None,
    out: Annotated[Path | None, Option(help="Folder for comparison.json and failures.csv.")] = None,
    force: shell.ForceOption = False,
    details: shell.DetailsOption = False,
) -> Answer:
    """Estimate how many times likelier ego A fails than ego B, in a scenario or summed over those of risk."""
    from rare_envs.study.evaluate import compare_egos

    env = env or asked.pop("env_id")
    if env is None:
        return _compare_risks(ego_a, ego_b, {**asked, "algo_b": algo_b, "stats_b": stats_b}, out, force, details)
    question, executor = _ask(env, {**asked, "max_sim": asked["max_sim"] or PAIR_SIMULATIONS}, ego=ego_a)
    tell = partial(_tell_comparison, details)
    b: dict[str, Any] = {"algo_b": algo_b, "stats_b": stats_b}
    with shell.telling_unwritten(tuple, tell):
        pair = compare_egos(question, ego_b, progress=True, out=out, force=force, executor=executor, **b)
    return tell(pair, out)


def _compare_risks(
    ego_a: str, ego_b: str, asked: dict[str, Any], out: Path | None, force: bool, details: bool
) -> Answer:
    """Compare two egos in the scenarios of risk."""
    from rare_envs.study.risk import SCENARIO_SET, RiskComparison, compare_risks

    executor, base, tell = _make_executor(asked), asked.pop("base"), partial(_tell_risk, details)
    options = {name: value for name, value in asked.items() if name not in (*shell.EXECUTOR, "env_id")}
    options |= {"bases": _read_bases([base] if base else [], SCENARIO_SET)}
    options |= {"max_sim": asked["max_sim"] or PAIR_SIMULATIONS, "executor": executor}
    with as_bad_input(ValueError), shell.telling_unwritten(RiskComparison, tell):
        found = compare_risks(ego_a, ego_b, out=out, progress=True, force=force, **options)
    return tell(found, out)


def _tell_comparison(details: bool, pair: tuple[Comparison, dict[str, Any]], out: Path | None = None) -> Answer:
    """Return the answer of a comparison."""
    from rare_envs.study.text import list_gate

    (found, answer), asked = pair, pair[1]["question"]
    verdict = None if asked["max_ratio"] is None else found.meets(asked["max_ratio"], asked["assume_traffic"])
    lines = [*answer["text"], *(["", found.details(), "", found.either.details()] if details else [])]
    lines += [*([] if out is None else [f"Wrote {out}."]), *list_gate(verdict)]
    code = (DOUBTFUL if found.warnings else 0) if verdict is None else GATE_CODES[verdict.decision]
    return Answer(answer, "\n".join(lines), code)


@command(*shell.EXECUTOR, "trust", stopped="Stopped before the run went on; what it had kept is still there.")
def resume_command(
    run: Annotated[Path, Argument(metavar="RUN", help="Folder of --out of an interrupted estimate, risk or compare.")],
    asked: dict[str, Any],
    ego: Annotated[str | None, Option(help="New address of an ego in another program, tcp://HOST:PORT.")] = None,
    on_error: Annotated[str | None, Option(help="New value of on_error: raise, failure or bound.")] = None,
    mend: Annotated[
        bool, Option("--mend", help="Keep the simulations before the damage of a damaged journal.")
    ] = False,
    details: shell.DetailsOption = False,
) -> Answer:
    """Continue an interrupted estimate, risk or compare; the result is the same as without the interruption."""
    from rare_envs.study import evaluate, writing

    executor, trust = _make_executor(asked), asked["trust"]
    folder, whole, questions = writing.find_whole(run, mend)
    if whole and (ego or on_error):
        raise BadInput(f"Expected --ego and --on-error with a run of rare-envs estimate; {str(run)!r} has another.")
    if not whole:
        report = evaluate.resume(run, ego, on_error, trust, progress=True, executor=executor)
        return describe_report(report, run, details)
    if whole["command"] == "estimate":
        from rare_envs.study.question import open_question

        (question,) = questions.values()
        opened = open_question(asdict(question), folder, trust, core=question.core, device=question.device)
        return estimate_highway_env(opened, whole["env_config"], folder, False, details, executor)
    if whole["command"] == "compare":
        with shell.telling_unwritten(tuple, partial(_tell_comparison, details)):
            return _tell_comparison(details, evaluate.resume_comparison(folder, questions, trust, executor), folder)
    from rare_envs.study.risk import Risk, RiskComparison, resume_compared_risks, resume_risk

    if whole["command"] == writing.SUM:
        with as_bad_input(ValueError), shell.telling_unwritten(RiskComparison, partial(_tell_risk, details)):
            compared = resume_compared_risks(folder, questions, whole, trust=trust, executor=executor)
            return _tell_risk(details, compared, folder)
    with as_bad_input(ValueError), shell.telling_unwritten(Risk, partial(_tell_risk, details)):
        return _tell_risk(details, resume_risk(folder, questions, whole, trust=trust, executor=executor), folder)
