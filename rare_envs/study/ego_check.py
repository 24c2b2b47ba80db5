"""`rare-envs check-ego`: does an ego fit, before simulations are spent on it?

The ego is loaded and asked (`rare_envs.study.probe`) in a process of its own, which may hang or die without ending the
check. A server is held against the protocol of docs/egos.md over its socket, message by message.
"""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from loky.backend import get_context
from rich.table import Table
from rich.text import Text

import agents
from agents.files import report_missing_file
from agents.loading import EGO_SUFFIXES, EXPECTED_EGO, find_ego_kind, strip_prefixes, suggest_ego
from agents.safe_pickle import TRUST_ADVICE, TRUST_CONSEQUENCE, find_origin_risks
from agents.saved_ego import find_statistics
from rare_envs.egos.needs import AMBIGUOUS, TAKEN_AS_ACCELERATIONS
from rare_envs.plugins import EgoGone, NoAnswer, reason_of
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.observation import map_kinds, observation_space
from rare_envs.startup import advise_install, use_one_thread
from rare_envs.study.arguments import BadInput, Question, as_bad_input
from rare_envs.study.probe import EGO_CHECKS, Finding, Probe, check_driving
from rare_envs.study.question import build_problem
from rare_envs.study.text import CleanConsole
from samplers.workers import SAFE_PATH, starting_processes

MEASUREMENTS = ("driving", "latency")
"""Checks whose result is of interest though it passed."""
STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
VERDICTS = {
    0: "The ego can be used.",
    2: "The ego cannot be used as it is.",
    3: "The ego can be used; mind the warnings.",
}


def exit_code(findings: list[Finding]) -> int:
    """Return 0 if the ego can be used, 2 if it cannot, 3 if it can but an estimate for it is doubtful.

    Example:
        >>> exit_code([Finding("memory", "pass", "none"), Finding("actions", "warn", "NaN", "check the weights")])
        3
    """
    if any(finding.status == "fail" for finding in findings):
        return 2
    return 3 if any(finding.status == "warn" and finding.doubtful for finding in findings) else 0


def print_findings(findings: list[Finding], title: str, everything: bool = False) -> None:
    """Print findings with their remedies, and the verdict; one line if all passed and not everything is asked for."""
    console = CleanConsole(highlight=False, markup=False)
    if not everything and all(each.status == "pass" for each in findings):
        console.print(f"{title} can be used: {len(findings)} checks passed (details: --all)")
        return
    table = Table("check", "", "found", "what to do", title=title, title_justify="left", title_style="bold")
    passed = []
    for each in findings:
        if everything or each.status != "pass" or each.advice or each.check in MEASUREMENTS:
            status = Text(each.status, style=STYLES[each.status])
            table.add_row(each.check, status, each.found, each.advice)
        else:
            passed.append(each.check)
    if passed:
        count = f"{len(passed)} other{'s' if len(passed) > 1 else ''}"
        table.add_row(count, Text("pass", style=STYLES["pass"]), ", ".join(passed), "")
    console.print(table)
    console.print(VERDICTS[exit_code(findings)])


START_TIMEOUT, COMPILING_TIMEOUT = 60.0, 600.0
"""Durations that the process may take before its first check, and for compiling rollouts [s]."""


def check_ego(question: Question, time_limit: float = 30.0) -> list[Finding]:
    """Check the ego of a question in the problem of that question."""
    with as_bad_input(ValueError):
        find_scenario(question.env_id)
    if time_limit <= 0:
        raise BadInput(f"Expected a time limit of some seconds, got {time_limit}.")
    name = strip_prefixes(question.ego)
    kind, path, found = find_ego_kind(name), Path(name), list[Finding]()
    if kind == "url":
        advice = "download the file, look where it comes from, name it"
        return [Finding("origin", "fail", f"{name!r} is a remote place", advice)]
    if kind == "unknown":
        raise BadInput(f"Unknown ego {name!r}{suggest_ego(name)}; expected {EXPECTED_EGO}.")
    if kind != "function" and name.endswith(EGO_SUFFIXES) and not path.exists():
        raise BadInput(report_missing_file(path))
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
    context = get_context("loky")  # the main script is not run again, as it is by multiprocessing
    with starting_processes():
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
    os.environ.pop(SAFE_PATH, None)
    os.dup2(2, 1)  # an ego may print
    with use_one_thread():
        for each in run_checks(question):
            to.send(each)
    to.send(None)


def run_checks(question: Question) -> Iterator[Finding | str]:
    """Load the ego and check it: yield findings, and before each check its name."""
    if find_ego_kind(question.ego) == "remote":
        yield "protocol"
        findings = list(check_protocol(question.ego))
        yield from findings
        if any(finding.status == "fail" for finding in findings):
            return
    yield "loading"
    try:
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        yield Finding("loading", "pass", ego if isinstance(ego, str) else type(ego).__name__)
        yield "compiling"  # takes no time of a check
        problem = build_problem(question, ego)
        for note in problem.notes:
            if note in (AMBIGUOUS, TAKEN_AS_ACCELERATIONS):  # of other bounds than ours a check of its own tells
                yield Finding("action space", "warn", note, "say which by --action", note == AMBIGUOUS)
            elif note in problem.needs.notes:
                yield Finding("loading", "warn", note, "see docs/egos.md", False)
        probe = Probe.of(ego, problem)
        if problem.core == "numba":  # then the ego is not asked
            problem.evaluate(problem.base.sample(1, np.random.default_rng(0)))
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
        yield Finding("loading", "fail", reason_of(error), "see docs/egos.md for what an ego is")
        return
    for check in EGO_CHECKS if probe.policy is not None else (check_driving,):
        yield (name := check.__name__.removeprefix("check_").replace("_", " "))
        try:
            yield from check(probe)
        except (Exception, SystemExit, EgoGone) as error:  # likewise
            gone = isinstance(error, EgoGone)
            yield Finding(name, "fail", reason_of(error), "start it again" if gone else "the ego failed in this check")
            if gone:
                return


PROTOCOL_ADVICE = "docs/egos.md has the protocol"


def check_protocol(spec: str) -> Iterator[Finding]:
    """Check a server."""
    try:
        from agents.remote import protocol
        from agents.remote.client import TIMEOUT, LinkError, RemoteError, ServerLink, parse_address
    except ImportError:
        yield Finding("protocol", "fail", "pyzmq and msgpack are not installed", advise_install("remote"))
        return
    address, settings = parse_address(spec)
    link, numbers = ServerLink(address, protocol.read_secret()), itertools.count(1)

    def ask(message: Any) -> Any:
        content = message if isinstance(message, bytes) else protocol.pack({"id": next(numbers), **message})
        return protocol.unpack(link.request(content, settings.get("timeout", TIMEOUT)))

    def compare(name: str, kind: str, reply: Any) -> Finding:
        found, reason = reply.get("type"), reply.get("reason", "")
        if found == kind:
            return Finding(name, "pass", f"{kind}: {reason}" if kind == "error" and reason else kind)
        return Finding(name, "fail", f"got {found!r} ({reason}), expected {kind!r}", PROTOCOL_ADVICE)

    try:
        link.open()
        before = ask({"type": "ping"})
        link.open()
        hello = ask({"type": "hello", "protocol": protocol.PROTOCOL, "client": "check-ego"})
        if hello.get("type") != "hello" or hello.get("protocol") != protocol.PROTOCOL:
            yield Finding("handshake", "fail", f"{hello.get('reason', hello)}", PROTOCOL_ADVICE)
            return
        yield Finding("handshake", "pass", f"protocol {protocol.PROTOCOL}, {hello.get('name', 'no name')!r}")
        yield compare("before hello", "error", before)
        for name, (kind, *messages) in _list_cases(hello).items():
            replies = [ask(message) for message in messages]
            steps = [isinstance(message, dict) and "step" in message for message in messages]
            acts = [reply for reply, step in zip(replies, steps, strict=True) if step]
            yield compare(name, kind, next((reply for reply in acts if reply.get("type") != kind), replies[-1]))
    except (LinkError, RemoteError, NoAnswer, EgoGone, ValueError) as error:
        yield Finding("protocol", "fail", reason_of(error), f"is it running at {address}? {PROTOCOL_ADVICE}")
    finally:
        link.close()


def _list_cases(hello: Any) -> dict[str, tuple[Any, ...]]:
    """Return the cases after the handshake: the reply to the last of some messages.

    A query has blank observations of the space that the server has declared.
    """
    from agents.remote import protocol

    space = protocol.decode_space(hello.get("observation")) or observation_space(vehicles=2)
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else space

    def act(session: int, step: int, rows: int = 3) -> dict[str, Any]:
        blank = map_kinds(lambda part: np.zeros((rows, *part.shape), part.dtype), parts)
        return {"type": "act", "session": session, "step": step, "observation": protocol.pack_observation(blank)}

    reset, ping = {"type": "reset", "session": 1, "batch": 3}, {"type": "ping"}
    one, other = ({**reset, "session": session} for session in (11, 12))
    empty = {"dtype": "<f4", "shape": [3, 7], "data": b""}
    return {
        "heartbeat": ("pong", ping),
        "unknown type": ("error", {"type": "dance"}),
        "no msgpack": ("error", b"\xc1 not a message"),
        "cut short": ("error", b"\x82\xa4type\xa5res"),
        "no reset": ("error", act(99, 0)),
        "reset": ("ready", reset),
        "act": ("action", act(1, 0)),
        "act again": ("action", act(1, 1)),
        "another step": ("error", act(1, 7)),
        "another batch": ("error", reset, act(1, 0, rows=4)),
        "data missing": ("error", reset, {**act(1, 0), "observation": empty}),
        "two sessions": ("action", one, other, act(11, 0), act(12, 0), act(11, 1), act(12, 1)),
        "end": ("ended", {"type": "end", "session": 1}),
        "after it all": ("pong", ping),
    }
