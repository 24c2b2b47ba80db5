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
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rare_envs.scenarios.registry import find_scenario
from rare_envs.study.arguments import Question
from rare_envs.study.ego_check.findings import Finding, report_failure, report_pass, report_warning
from rare_envs.study.errors import BadInput
from rare_envs.threads import use_one_thread

START_TIMEOUT = 60.0
"""Duration that the process may take before its first check [s]."""


def check_ego(question: Question, time_limit: float = 30.0) -> list[Finding]:
    """Check the ego of a question in the problem of that question.

    Args:
        question: The ego, its environment, and what it sees there.
        time_limit: Duration that one check may take [s].

    Returns:
        The findings in order; the last one is a failure if the ego cannot be loaded, hangs or dies.

    Raises:
        BadInput: The environment or the ego is unknown, or there is no such file.

    Example:
        >>> for finding in check_ego(Question(env_id="rare_envs/CutIn-v0", ego="https://example.org/ego.zip")):
        ...     print(finding.check, finding.status, finding.found)
        origin fail 'https://example.org/ego.zip' is a remote place
    """
    from agents.files import report_missing_file
    from agents.loading import EGO_SUFFIXES, EXPECTED_EGO, find_ego_kind, strip_prefixes, suggest_ego
    from agents.safe_pickle import TRUST_ADVICE, TRUST_CONSEQUENCE, find_origin_risks
    from agents.saved_ego import find_statistics

    try:
        find_scenario(question.env_id)
    except ValueError as error:
        raise BadInput(error) from error
    if time_limit <= 0:
        raise BadInput(f"Expected a time limit of some seconds, got {time_limit}.")
    name = strip_prefixes(question.ego)
    findings, kind = [], find_ego_kind(name)
    if kind == "url":
        return [
            report_failure(
                "origin", f"{name!r} is a remote place", "download the file, look where it comes from, name it"
            )
        ]
    if kind == "unknown":
        raise BadInput(f"Unknown ego {name!r}{suggest_ego(name)}; expected {EXPECTED_EGO}.")
    if name.endswith(EGO_SUFFIXES) and not Path(name).exists():
        raise BadInput(report_missing_file(Path(name)))
    if kind == "zip":
        reasons = find_origin_risks(Path(name), find_statistics(Path(name)))
        if reasons and not question.trust:
            return [report_failure("origin", "; ".join(reasons), TRUST_ADVICE)]
        place = f" ({'; '.join(reasons)})" if reasons else ""
        held = f"a Stable-Baselines3 .zip can hold code{place}"
        if question.trust:
            findings.append(report_warning("origin", held, f"you said --trust: {TRUST_CONSEQUENCE}", False))
        else:
            findings.append(report_pass("origin", f"{held}; opened here is only what is known to be harmless"))
    return findings + list(_check_in_subprocess(question, time_limit))


def _check_in_subprocess(question: Question, time_limit: float) -> Iterator[Finding]:
    """Yield the findings of a subprocess, and a failure if it hangs or dies."""
    words = [sys.executable, "-m", "rare_envs.study.ego_check.subprocess_check", json.dumps(asdict(question))]
    with subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=_forward_lines, args=(process.stdout, lines), daemon=True).start()
        doing, limit, done = "loading", max(START_TIMEOUT, time_limit), False
        while not done:
            try:
                line = lines.get(timeout=limit)
            except queue.Empty:
                process.kill()
                advice = "an ego that hangs stops the run; process:EGO?timeout=SECONDS would end it there"
                yield report_failure(doing, f"no end after {limit:g} s", advice)
                return
            if line is None:
                break
            with suppress(json.JSONDecodeError):  # other output of libraries
                event = json.loads(line)
                doing, limit = event.get("doing", doing), time_limit
                done = event.get("done", False)
                if "finding" in event:
                    yield Finding(**event["finding"])
        if not done:
            status = process.wait()
            advice = "an ego that ends its process ends the run; process:EGO would survive it"
            yield report_failure(doing, f"the process ended (exit status {status})", advice)


def _forward_lines(stream: Any, lines: queue.Queue[str | None]) -> None:
    for line in stream:
        lines.put(line)
    lines.put(None)


# --- in that process ---------------------------------------------------------------------------


def run_checks(question: Question) -> Iterator[Finding | str]:
    """Load the ego and check it: yield findings, and before each check its name."""
    import agents
    from agents.loading import find_ego_kind
    from rare_envs.egos.errors import EgoGone, reason_of
    from rare_envs.egos.needs import AMBIGUOUS, TAKEN_AS_ACCELERATIONS
    from rare_envs.study.ego_check.checks import EGO_CHECKS, Probe, check_driving
    from rare_envs.study.ego_check.protocol import check_protocol
    from rare_envs.study.question import build_problem

    if find_ego_kind(question.ego) == "remote":
        yield "protocol"
        findings = list(check_protocol(question.ego))
        yield from findings
        if any(finding.status == "fail" for finding in findings):
            return
    yield "loading"
    try:
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        yield report_pass("loading", f"{type(ego).__name__}" if not isinstance(ego, str) else ego)
        problem = build_problem(question, ego)
        for note in problem.notes:
            if note in (AMBIGUOUS, TAKEN_AS_ACCELERATIONS):  # of other bounds than ours a check of its own tells
                yield report_warning("action space", note, "say which by --action", note == AMBIGUOUS)
        probe = Probe.of(ego, problem)
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
        yield report_failure("loading", reason_of(error), "see docs/egos.md for what an ego is")
        return
    for check in EGO_CHECKS if probe.policy is not None else (check_driving,):
        name = check.__name__.removeprefix("check_").replace("_", " ")
        yield name
        try:
            yield from check(probe)
        except EgoGone as error:
            yield report_failure(name, reason_of(error), "start it again")
            return
        except (Exception, SystemExit) as error:  # likewise
            yield report_failure(name, reason_of(error), "the ego failed in this check")


def _main(arguments: str) -> None:
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # an ego may print
    with use_one_thread():
        for each in run_checks(Question(**json.loads(arguments))):
            out.write(json.dumps({"doing": each} if isinstance(each, str) else {"finding": asdict(each)}) + "\n")
    out.write(json.dumps({"done": True}) + "\n")


if __name__ == "__main__":
    _main(sys.argv[1])
