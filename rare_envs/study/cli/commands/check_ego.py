"""Command `check-ego`: whether an ego fits an environment, in seconds."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from rare_envs.study.cli.options import (
    AlgoOption,
    EgoArgument,
    EnvArgument,
    JsonOption,
    ScenarioOptions,
    StatsOption,
    TrustOption,
)
from rare_envs.study.cli.shell import print_json
from training.command_line import spread_options


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
    from rare_envs.study.ego_check.findings import exit_code
    from rare_envs.study.ego_check.subprocess_check import EgoCheckRequest, check_ego
    from rare_envs.study.ego_check.table import VERDICTS, print_findings

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
