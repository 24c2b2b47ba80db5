"""`rare-envs check-ego`: does an ego fit, before simulations are spent on it?

The ego is loaded and asked in a process of its own, which may hang or die without ending the check.

A server is held against the protocol of docs/egos.md over its socket, message by message.
"""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from loky.backend import get_context

from rare_envs.plugins import EgoGone, reason_of
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.observation import map_kinds
from rare_envs.startup import use_one_thread
from rare_envs.study.arguments import BadInput, Question, as_bad_input
from rare_envs.study.ego_check import Finding, report_failure, report_pass, report_warning

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
                doing = event
                limit = COMPILING_TIMEOUT if event == "compiling" else time_limit
        advice = "an ego that hangs stops the run; process:EGO?timeout=SECONDS would end it there"
        yield report_failure(doing, f"no end after {limit:g} s", advice)
    except EOFError:
        process.join()
        advice = "an ego that ends its process ends the run; process:EGO would survive it"
        yield report_failure(doing, f"the process ended (exit status {process.exitcode})", advice)
    finally:
        if process.is_alive():
            os.kill(process.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
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
    from rare_envs.egos.needs import AMBIGUOUS, TAKEN_AS_ACCELERATIONS
    from rare_envs.plugins import EgoGone, reason_of
    from rare_envs.study.ego_check.checks import EGO_CHECKS, Probe, check_driving
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


PROTOCOL_ADVICE = "docs/egos.md has the protocol"


def check_protocol(spec: str) -> Iterator[Finding]:
    """Check a server."""
    try:
        from agents.remote import protocol
        from agents.remote.client import TIMEOUT, LinkError, RemoteError, ServerLink, parse_address
        from agents.remote.protocol import read_secret
    except ImportError:
        yield report_failure("protocol", "pyzmq and msgpack are not installed", "pip install 'rare-envs[remote]'")
        return
    address, settings = parse_address(spec)
    timeout = settings.get("timeout", TIMEOUT)
    link, numbers = ServerLink(address, read_secret()), itertools.count(1)

    def ask(message: Any) -> Any:
        content = message if isinstance(message, bytes) else protocol.pack({"id": next(numbers), **message})
        return protocol.unpack(link.request(content, timeout))

    try:
        link.open()
        before = ask({"type": "ping"})
        link.open()
        hello = ask({"type": "hello", "protocol": protocol.PROTOCOL, "client": "check-ego"})
        if hello.get("type") != "hello" or hello.get("protocol") != protocol.PROTOCOL:
            yield report_failure("handshake", f"{hello.get('reason', hello)}", PROTOCOL_ADVICE)
            return
        yield report_pass("handshake", f"protocol {protocol.PROTOCOL}, {hello.get('name', 'no name')!r}")
        yield _compare_reply("before hello", before, "error")
        for name, (kind, *messages) in _list_cases(hello).items():
            replies = [ask(message) for message in messages]
            yield _compare_reply(name, replies[-1], kind)
        yield _compare_reply("two sessions", _alternate(hello, ask), "action")
        yield _compare_reply("end", ask({"type": "end", "session": 1}), "ended")
        yield _compare_reply("after it all", ask({"type": "ping"}), "pong")
    except (LinkError, RemoteError, EgoGone, ValueError) as error:
        yield report_failure("protocol", reason_of(error), f"is it running at {address}? {PROTOCOL_ADVICE}")
    finally:
        link.close()


def _act(hello: Any, session: int, step: int, rows: int = 3) -> dict[str, Any]:
    """Return a query with blank observations of the space that the server has declared."""
    from agents.remote import protocol

    space = protocol.decode_space(hello.get("observation")) or spaces.Box(-5.0, 5.0, (7,), np.float32)
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else space
    blank = map_kinds(lambda part: np.zeros((rows, *part.shape), part.dtype), parts)
    return {"type": "act", "session": session, "step": step, "observation": protocol.pack_observation(blank)}


def _list_cases(hello: Any) -> dict[str, tuple[Any, ...]]:
    """Return the cases after the handshake: the reply to the last of some messages."""
    act, reset = partial(_act, hello), {"type": "reset", "session": 1, "batch": 3}
    empty = {"dtype": "<f4", "shape": [3, 7], "data": b""}
    return {
        "heartbeat": ("pong", {"type": "ping"}),
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
    }


def _alternate(hello: Any, ask: Callable[[Any], Any]) -> dict[str, Any]:
    """Return what a server replies to two sessions that take turns; all kinds of reply where they differ."""
    for session in (11, 12):
        ask({"type": "reset", "session": session, "batch": 3})
    kinds = [ask(_act(hello, session, step)).get("type") for step in (0, 1) for session in (11, 12)]
    return {"type": kinds[0] if len(set(kinds)) == 1 else kinds}


def _compare_reply(name: str, reply: Any, kind: str) -> Finding:
    """Return whether a reply is of the kind that the protocol demands."""
    reply_type = reply.get("type")
    if reply_type == kind:
        return report_pass(name, f"{kind}: {reply['reason']}" if kind == "error" and "reason" in reply else kind)
    return report_failure(name, f"got {reply_type!r} ({reply.get('reason', '')}), expected {kind!r}", PROTOCOL_ADVICE)
