"""`rare-envs check-ego`: does an ego fit, before simulations are spent on it?

The ego is loaded and asked in a process of its own, which may hang or die without ending the check.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rare_envs.scenarios.registry import find_scenario
from rare_envs.startup import use_one_thread
from rare_envs.study.arguments import BadInput, Question, as_bad_input

START_TIMEOUT, COMPILING_TIMEOUT = 60.0, 600.0
"""Durations that the process may take before its first check, and for compiling rollouts [s]."""
MEASUREMENTS = ("driving", "latency")
"""Checks whose result is of interest though it passed."""
STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
VERDICTS = {
    0: "The ego can be used.",
    2: "The ego cannot be used as it is.",
    3: "The ego can be used; mind the warnings.",
}


@dataclass(frozen=True)
class Finding:
    """One line of the table of a check.

    Example:
        >>> exit_code([Finding("memory", "pass", "none"), Finding("actions", "warn", "NaN", "check the weights")])
        3
    """

    check: str
    """The property that was checked."""
    status: Literal["pass", "warn", "fail"]
    found: str
    """The result, in words."""
    advice: str = ""
    """The remedy."""
    doubtful: bool = True
    """Whether, as a warning, it makes an estimate doubtful."""


def exit_code(findings: list[Finding]) -> int:
    """Return 0 if the ego can be used, 2 if it cannot, 3 if it can but an estimate for it is doubtful."""
    if any(finding.status == "fail" for finding in findings):
        return 2
    return 3 if any(finding.status == "warn" and finding.doubtful for finding in findings) else 0


def print_findings(findings: list[Finding], title: str, everything: bool = False) -> None:
    """Print findings with their remedies, and the verdict."""
    table = Table("check", "", "found", "what to do", title=Text(title), title_justify="left", title_style="bold")
    passed = []
    for each in findings:
        if everything or each.status != "pass" or each.advice or each.check in MEASUREMENTS:
            status = Text(each.status, style=STYLES[each.status])
            table.add_row(Text(each.check), status, Text(each.found), Text(each.advice))
        else:
            passed.append(each.check)
    if passed:
        count = f"{len(passed)} other{'s' if len(passed) > 1 else ''}"
        table.add_row(Text(count), Text("pass", style=STYLES["pass"]), Text(", ".join(passed)), "")
    console = Console(highlight=False)
    console.print(table)
    console.print(VERDICTS[exit_code(findings)], markup=False)


def check_ego(question: Question, time_limit: float = 30.0) -> list[Finding]:
    """Check the ego of a question in the problem of that question."""
    from agents.files import report_missing_file
    from agents.loading import EGO_SUFFIXES, EXPECTED_EGO, find_ego_kind, strip_prefixes, suggest_ego
    from agents.safe_pickle import TRUST_ADVICE, TRUST_CONSEQUENCE, find_origin_risks
    from agents.saved_ego import find_statistics

    with as_bad_input(ValueError):
        find_scenario(question.env_id)
    if time_limit <= 0:
        raise BadInput(f"Expected a time limit of some seconds, got {time_limit}.")
    name = strip_prefixes(question.ego)
    kind, path = find_ego_kind(name), Path(name)
    if kind == "url":
        advice = "download the file, look where it comes from, name it"
        return [Finding("origin", "fail", f"{name!r} is a remote place", advice)]
    if kind == "unknown":
        raise BadInput(f"Unknown ego {name!r}{suggest_ego(name)}; expected {EXPECTED_EGO}.")
    if name.endswith(EGO_SUFFIXES) and not path.exists():
        raise BadInput(report_missing_file(path))
    found = []
    if kind == "zip":
        reasons = "; ".join(find_origin_risks(path, find_statistics(path)))
        held = f"a Stable-Baselines3 .zip can hold code{f' ({reasons})' if reasons else ''}"
        if question.trust:
            found.append(Finding("origin", "warn", held, f"you said --trust: {TRUST_CONSEQUENCE}", False))
        elif reasons:
            return [Finding("origin", "fail", reasons, TRUST_ADVICE)]
        else:
            found.append(Finding("origin", "pass", f"{held}; opened here is only what is known to be harmless"))
    return [*found, *_check_in_subprocess(question, time_limit)]


def _check_in_subprocess(question: Question, time_limit: float) -> Iterator[Finding]:
    """Yield the findings of a process that is started anew, and a failure if it hangs or dies."""
    from loky.backend import get_context

    context = get_context("loky")  # the main script is not run again, as it is by multiprocessing
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
                doing, limit = event, COMPILING_TIMEOUT if event == "compiling" else time_limit
        advice = "an ego that hangs stops the run; process:EGO?timeout=SECONDS would end it there"
        yield Finding(doing, "fail", f"no end after {limit:g} s", advice)
    except EOFError:
        process.join()
        advice = "an ego that ends its process ends the run; process:EGO would survive it"
        yield Finding(doing, "fail", f"the process ended (exit status {process.exitcode})", advice)
    finally:
        if process.is_alive():
            os.kill(process.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        process.join()


def _send_findings(question: Question, to: Connection) -> None:
    """Run the checks in that process: send each finding, before each check its name, and None at the end."""
    from rare_envs.study.ego_check.checks import run_checks

    os.dup2(2, 1)  # an ego may print
    with use_one_thread():
        for each in run_checks(question):
            to.send(each)
    to.send(None)
