"""`rare-envs check-ego`: does an ego fit, before simulations are spent on it?

The ego is loaded and asked in a process of its own, which may hang or die without ending the check.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rare_envs.study.ego_check.findings import Finding, failed, passed, warned
from rare_envs.study.errors import BadInput

START = 60.0
"""Seconds that the process may take before its first check."""


@dataclass(frozen=True)
class Asked:
    """What is to be checked.

    Attributes:
        ego: As for `agents.load_ego`.
        env_id: Environment.
        algo: Algorithm of a `.zip`, if the file does not tell.
        trust: As for `agents.load_ego`.
        observation: What the ego observes; None for what it asks for itself.
        action: What it decides.
        time_limit: Seconds that one check may take.
        base: Base distribution of the scenarios it is tried on; the environment's default when None.
        drivers: Of the vehicles around it; the environment's default when None.
        horizon: Length of an episode [s]; the environment's when None.
    """

    ego: str
    env_id: str
    algo: str | None = None
    trust: bool = False
    observation: str | None = None
    action: str = "continuous"
    time_limit: float = 30.0
    base: str | None = None
    drivers: str | None = None
    horizon: float | None = None


def check_ego(asked: Asked) -> list[Finding]:
    """Check an ego.

    Args:
        asked: What is to be checked.

    Returns:
        What was found, in order; the last finding is a failure if the ego cannot even be loaded, hangs or dies.

    Raises:
        BadInput: The environment is unknown, or there is no such file.
    """
    from agents.loading import find_ego_kind, strip_prefixes
    from agents.sb3.file_trust import TRUST_ADVICE, TRUSTED, find_origin_risks
    from agents.sb3.saved_ego import find_statistics
    from rare_envs.scenarios.registry import find_scenario

    try:
        find_scenario(asked.env_id)
    except ValueError as error:
        raise BadInput(error) from error
    if asked.time_limit <= 0:
        raise BadInput(f"Expected a time limit of some seconds, got {asked.time_limit}.")
    name = strip_prefixes(asked.ego)
    findings, kind = [], find_ego_kind(name)
    if kind == "url":
        return [failed("origin", f"{name!r} is a remote place", "download the file, look where it comes from, name it")]
    if kind == "zip":
        reasons = find_origin_risks(Path(name), find_statistics(Path(name)))
        if reasons and not asked.trust:
            return [failed("origin", "; ".join(reasons), TRUST_ADVICE)]
        place = f" ({'; '.join(reasons)})" if reasons else ""
        advice = f"you said --trust: {TRUSTED}" if asked.trust else "opened here is only what is known to be harmless"
        findings.append(warned("origin", f"a Stable-Baselines3 .zip can hold code{place}", advice, False))
    return findings + list(_in_a_process(asked))


def _in_a_process(asked: Asked) -> Iterator[Finding]:
    """Findings of a process of its own; of the process itself, if it hangs or dies."""
    words = [sys.executable, "-m", "rare_envs.study.ego_check.subprocess_check", json.dumps(asdict(asked))]
    with subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=_pass_on, args=(process.stdout, lines), daemon=True).start()
        doing, limit, done = "loading", max(START, asked.time_limit), False
        while not done:
            try:
                line = lines.get(timeout=limit)
            except queue.Empty:
                process.kill()
                advice = "an ego that hangs stops the run; process:EGO?timeout=SECONDS would end it there"
                yield failed(doing, f"no end after {limit:g} s", advice)
                return
            if line is None:
                break
            with suppress(json.JSONDecodeError):  # what else might be written
                event = json.loads(line)
                doing, limit = event.get("doing", doing), asked.time_limit
                done = event.get("done", False)
                if "finding" in event:
                    yield Finding(**event["finding"])
        if not done:
            status = process.wait()
            advice = "an ego that ends its process ends the run; process:EGO would survive it"
            yield failed(doing, f"the process ended (exit status {status})", advice)


def _pass_on(stream: Any, lines: queue.Queue[str | None]) -> None:
    for line in stream:
        lines.put(line)
    lines.put(None)


# --- in that process ---------------------------------------------------------------------------


def findings_of(asked: Asked) -> Iterator[Finding | str]:
    """Load the ego and check it: findings, and before each check its name."""
    import agents
    from agents.loading import find_ego_kind
    from rare_envs import DrivingProblem
    from rare_envs.egos.faults import EgoGone, reason_of
    from rare_envs.problem import AmbiguousActions
    from rare_envs.study.ego_check.behaviour import CHECKS, drives
    from rare_envs.study.ego_check.probe import Probe
    from rare_envs.study.ego_check.protocol import conformance

    if find_ego_kind(asked.ego) == "remote":
        yield "protocol"
        found = list(conformance(asked.ego))
        yield from found
        if any(finding.status == "fail" for finding in found):
            return
    yield "loading"
    try:
        ego = agents.load_ego(asked.ego, algo=asked.algo, trust=asked.trust)
        yield passed("loading", f"{type(ego).__name__}" if not isinstance(ego, str) else ego)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AmbiguousActions)
            problem = DrivingProblem(
                asked.env_id,
                ego=ego,
                observation=asked.observation,
                action=asked.action,
                base=asked.base,
                drivers=asked.drivers,
                horizon=asked.horizon,
            )
        for note in problem.notes:
            yield warned("action space", note, "say --action meta if it was trained there")
        probe = Probe.of(ego, problem)
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
        yield failed("loading", reason_of(error), "see docs/egos.md for what an ego is")
        return
    for check in CHECKS if probe.policy is not None else (drives,):
        name = check.__name__.replace("_", " ")
        yield name
        try:
            yield from check(probe)
        except EgoGone as error:
            yield failed(name, reason_of(error), "start it again")
            return
        except (Exception, SystemExit) as error:  # likewise
            yield failed(name, reason_of(error), "the ego failed when it was asked")


def _main(arguments: str) -> None:
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # an ego may print
    import torch

    torch.set_num_threads(1)
    for each in findings_of(Asked(**json.loads(arguments))):
        out.write(json.dumps({"doing": each} if isinstance(each, str) else {"finding": asdict(each)}) + "\n")
    out.write(json.dumps({"done": True}) + "\n")


if __name__ == "__main__":
    _main(sys.argv[1])
