"""`rare-envs check-ego`: does an ego fit, before simulations are spent on it?

The ego is loaded and asked in a process of its own, which may hang or die without ending the check.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from rare_envs.scenarios.registry import find_scenario
from rare_envs.study.arguments import Question
from rare_envs.study.ego_check import Finding, report_failure, report_pass, report_warning
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.threads import use_one_thread

START_TIMEOUT, COMPILING_TIMEOUT = 60.0, 600.0
"""Durations that the process may take before its first check, and for compiling rollouts [s]."""


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

    with as_bad_input(ValueError):
        find_scenario(question.env_id)
    if time_limit <= 0:
        raise BadInput(f"Expected a time limit of some seconds, got {time_limit}.")
    name = strip_prefixes(question.ego)
    findings, kind = [], find_ego_kind(name)
    if kind == "url":
        advice = "download the file, look where it comes from, name it"
        return [report_failure("origin", f"{name!r} is a remote place", advice)]
    if kind == "unknown":
        raise BadInput(f"Unknown ego {name!r}{suggest_ego(name)}; expected {EXPECTED_EGO}.")
    if name.endswith(EGO_SUFFIXES) and not Path(name).exists():
        raise BadInput(report_missing_file(Path(name)))
    if kind == "zip":
        reasons = "; ".join(find_origin_risks(Path(name), find_statistics(Path(name))))
        if reasons and not question.trust:
            return [report_failure("origin", reasons, TRUST_ADVICE)]
        held = f"a Stable-Baselines3 .zip can hold code{f' ({reasons})' if reasons else ''}"
        findings.append(
            report_warning("origin", held, f"you said --trust: {TRUST_CONSEQUENCE}", False)
            if question.trust
            else report_pass("origin", f"{held}; opened here is only what is known to be harmless")
        )
    return findings + list(_check_in_subprocess(question, time_limit))


def _check_in_subprocess(question: Question, time_limit: float) -> Iterator[Finding]:
    """Yield the findings of a process that is started anew, and a failure if it hangs or dies."""
    context = multiprocessing.get_context("spawn")
    received, sent = context.Pipe(duplex=False)
    process = context.Process(target=_send_findings, args=(question, sent))
    process.start()
    sent.close()  # so that its end is noticed
    doing, limit = "loading", max(START_TIMEOUT, time_limit)
    try:
        while received.poll(limit):
            event, limit = received.recv(), time_limit
            if event is None:
                return
            if isinstance(event, Finding):
                yield event
            else:
                doing = event
                limit = COMPILING_TIMEOUT if event == "compiling" else time_limit
        advice = "an ego that hangs stops the run; process:EGO?timeout=SECONDS would end it there"
        yield report_failure(doing, f"no end after {limit:g} s", advice)
    except EOFError:
        process.join()
        advice = "an ego that ends its process ends the run; process:EGO would survive it"
        yield report_failure(doing, f"the process ended (exit status {process.exitcode})", advice)
    finally:
        process.kill()
        process.join()


def _send_findings(question: Question, to: Connection) -> None:
    """Run the checks in that process: send each finding, before each check its name, and None at the end."""
    os.dup2(2, 1)  # an ego may print
    with use_one_thread():
        for each in run_checks(question):
            to.send(each)
    to.send(None)


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
        yield "compiling"  # takes no time of a check
        problem = build_problem(question, ego)
        for note in problem.notes:
            if note in (AMBIGUOUS, TAKEN_AS_ACCELERATIONS):  # of other bounds than ours a check of its own tells
                yield report_warning("action space", note, "say which by --action", note == AMBIGUOUS)
        probe = Probe.of(ego, problem)
        if problem.core == "numba":  # then the ego is not asked
            problem.evaluate(problem.base.sample(1, np.random.default_rng(0)))
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
