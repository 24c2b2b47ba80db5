"""A remote ego drives as a local one, outlives a lost connection, and its failures are told apart."""

from __future__ import annotations

import itertools
import pickle
import threading
import time
from typing import Any

import msgpack
import numpy as np
import pytest
from gymnasium import spaces

from agents import load_ego
from agents.remote import protocol
from agents.remote.client import NoReply, RemoteEgo, RemoteError, parse_address
from agents.remote.request_handler import RequestHandler
from rare_envs.egos.errors import EgoGone, NoAnswer
from samplers.evaluate import Evaluator
from tests.agents.remote.egos import Averaging, Braking, problem


@pytest.mark.parametrize("ego", [Braking(), Averaging()])
def test_an_ego_elsewhere_drives_as_at_home(ego: Any, serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    there = connect_ego(serve(ego).address)
    assert there.observation_space == ego.observation_space
    assert there.action_space == ego.action_space
    for rows in (x, x[:7], x[:1], x):
        np.testing.assert_array_equal(problem(there).evaluate(rows), problem(ego).evaluate(rows))
    assert there.ping() < 20.0


def test_discrete_actions_and_wide_ones_arrive(serve: Any, connect_ego: Any) -> None:
    class Counting(Braking):
        def predict(self, observation: Any, **_: Any) -> Any:
            return np.arange(len(observation)) if len(observation) < 5 else np.full((len(observation), 2), 1 / 3), None

    there = connect_ego(serve(Counting()).address)
    action, state = there.predict(np.zeros((4, 7), np.float32))
    assert (action.tolist(), action.dtype, state) == ([0, 1, 2, 3], np.int64, None)
    assert there.predict(np.zeros((5, 7)))[0][0, 0] == 1 / 3


def test_rows_begin_anew_where_their_episodes_do(serve: Any, connect_ego: Any) -> None:
    there, home = connect_ego(serve(Averaging()).address), Averaging()
    states: list[Any] = [None, None]
    for tick in range(4):
        observation = np.full((3, 7), tick, np.float32)
        start = np.array([tick == 0, tick in (0, 2), tick == 0])
        found = [ego.predict(observation, states[k], start) for k, ego in enumerate((there, home))]
        states = [state for _, state in found]
        np.testing.assert_array_equal(found[0][0], found[1][0])


@pytest.mark.parametrize("ego", [Braking, Averaging])
def test_an_ego_that_is_killed_and_started_again_loses_nothing(
    ego: Any, serve: Any, connect_ego: Any, x: np.ndarray
) -> None:
    first = serve(ego())
    there = connect_ego(first.address)
    calls = itertools.count()
    plain, predict = problem(ego()).evaluate(x), there.predict

    def interrupted(*words: Any, **more: Any) -> Any:
        if next(calls) == 7:
            first.end()
            threading.Timer(0.5, lambda: serve(ego(), first.address)).start()
        return predict(*words, **more)

    there.predict = interrupted
    np.testing.assert_array_equal(problem(there).evaluate(x), plain)
    assert next(calls) == 20


def test_two_batches_at_a_time_do_not_mix(serve: Any, connect_ego: Any) -> None:
    there, home = connect_ego(serve(Averaging()).address), Averaging()
    states: dict[str, Any] = dict.fromkeys(["a", "b", "c", "d"])
    for tick, name in itertools.product(range(3), ("a", "b")):
        observation = np.full((2, 7), ord(name) + tick, np.float32)
        one, states[name] = there.predict(observation, states[name], np.full(2, tick == 0))
        other, states[chr(ord(name) + 2)] = home.predict(observation, states[chr(ord(name) + 2)], np.full(2, tick == 0))
        np.testing.assert_array_equal(one, other)


def test_many_batches_with_a_memory_are_forgotten_in_time(serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    server = serve(Averaging())
    there = connect_ego(server.address)
    for _ in range(10):
        problem(there).evaluate(x[:2])
    (peer,) = server._handler._clients.values()
    assert len(peer.sessions) <= 2


def test_an_ego_that_does_not_come_back_is_gone(serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    server = serve(Braking())
    there = connect_ego(server.address, patience=0.3)
    server.end()
    with pytest.raises(EgoGone, match=r"No ego at tcp://.* within 0\.3 s"):
        Evaluator(problem(there), on_error="bound").evaluate(x)
    with pytest.raises(ValueError, match=r"No ego at tcp://.* within 0\.2 s"):
        load_ego(f"{server.address}?patience=0.2")


def test_another_ego_that_comes_back_is_not_taken_for_the_first(serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    class Other(Braking):
        observation_space = spaces.Box(-1.0, 1.0, (7,), np.float32)

    first = serve(Braking())
    there = connect_ego(first.address)
    first.end()
    serve(Other(), first.address)
    with pytest.raises(EgoGone, match="one with other spaces is there now"):
        Evaluator(problem(there), on_error="bound").evaluate(x)


def test_an_ego_that_answers_too_late_is_a_fault_of_its_scenarios(serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    class Slow(Braking):
        def predict(self, observation: Any, episode_start: Any = None, **more: Any) -> Any:
            if (episode_start & (np.abs(50 * observation[:, 3] - 20.0) < 0.1)).any():
                time.sleep(0.6)
            return super().predict(observation)

    x = x[:4].copy()
    x[:, 2] = [60.0, 20.0, 70.0, 80.0]
    there = connect_ego(serve(Slow()).address, timeout=0.25)
    tolerant = Evaluator(problem(there), on_error="bound")
    f = tolerant.evaluate(x)
    np.testing.assert_array_equal(np.isnan(f), x[:, 2] < 21.0)
    assert "no answer within 0.25 s" in tolerant.faults[0].reason


@pytest.mark.parametrize("memory", [False, True])
def test_what_the_ego_raises_arrives_as_the_reason(memory: bool, serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    class Raising(Averaging if memory else Braking):  # type: ignore[misc]
        def predict(self, observation: Any, state: Any = None, *rest: Any, **more: Any) -> Any:
            if (observation[:, 3] < 0.6).any():
                raise RuntimeError("no road")
            return super().predict(observation, state, **more)

    x = x.copy()
    x[:, 2] = np.where(np.arange(40) % 20 == 3, 20.0, 70.0)
    tolerant = Evaluator(problem(connect_ego(serve(Raising()).address)), on_error="bound")
    np.testing.assert_array_equal(np.isnan(tolerant.evaluate(x)), x[:, 2] == 20.0)
    assert {fault.reason for fault in tolerant.faults} == {"RemoteError: RuntimeError: no road"}


@pytest.mark.parametrize(
    "reply",
    [b"", b"\x81", msgpack.packb({"type": "action"}), msgpack.packb([1]), pickle.dumps(3)],
)
def test_a_server_that_answers_nonsense_is_a_fault(reply: bytes, serve: Any, connect_ego: Any) -> None:
    server = serve(Braking())
    there = connect_ego(server.address)
    handle = server._handler.handle

    def nonsense(connection: bytes, content: bytes) -> bytes:
        return reply if protocol.unpack(content)["type"] == "act" else handle(connection, content)

    server._handler.handle = nonsense
    with pytest.raises(RemoteError, match="failed twice on this batch"):
        there.predict(np.zeros((1, 7), np.float32))


class Hung(BaseException):
    """Stands for a call that does not return, or not in time."""


class VirtualLink:
    """Answers at once, but for rows that begin with certain gaps: it hangs on some, and takes 2 s for others."""

    address = "virtual"
    load_timeout = 0.0

    def __init__(self, memory: bool) -> None:
        self.memory, self.waits, self.starts, self.questions = memory, list[float](), 0, 0

    def open(self) -> None:
        self.starts += 1
        self.handler = RequestHandler(self)

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        gap = 50 * observation[:, 3]
        self.questions += 1
        if episode_start[0] and ((gap > 30) & (gap < 32)).any():
            raise Hung
        if episode_start[0] and ((gap > 40) & (gap < 42)).any() and self.timeout < 2.0:
            raise Hung
        return np.full((len(observation), 2), -0.1, np.float32), 1 if self.memory else None

    def request(self, content: bytes, timeout: float) -> bytes:
        self.timeout = timeout
        try:
            return self.handler.handle(b"", content)
        except Hung:
            self.waits.append(timeout)
            raise NoReply(f"no answer within {timeout:.3g} s") from None

    def close(self) -> None:
        pass


@pytest.mark.parametrize("memory", [False, True])
def test_rows_that_hang_are_found_at_little_cost_and_slow_ones_not_accused(memory: bool) -> None:
    n, link = 400, VirtualLink(memory)
    world = problem(RemoteEgo(link, timeout=10.0))
    x = world.base.sample(n, np.random.default_rng(0))
    x[:, 2] = np.where(np.arange(n) % 2, 60.0, 80.0)
    world.evaluate(x[:5])  # it has answered before
    hanging, slow = [123, 300], [5, 6, 133, 399]
    x[hanging, 2], x[slow, 2] = 31.0, 41.0
    tolerant, link.questions = Evaluator(world, on_error="bound"), 0
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(tolerant.evaluate(x))), hanging)
    assert {fault.reason for fault in tolerant.faults} == {"NoAnswer: The ego at virtual: no answer within 10 s."}
    # once for all, once for each row alone, once for both when they are tried again, and once more for each
    assert link.waits.count(10.0) <= 1 + 2 + 1 + 2 + 2  # or where it has just been started again, a part
    assert link.waits.count(0.5) <= 3 + 1 + 1  # for a part with such rows, or both of them
    assert link.starts == 1 + len(link.waits)
    ticks = 20 if memory else 1
    assert link.questions < ticks * (20 + 5 * 20 + 20) + 20


def test_a_plain_evaluation_asks_twice_before_it_gives_up(x: np.ndarray) -> None:
    link = VirtualLink(memory=False)
    x = x.copy()
    x[0, 2] = 31.0
    with pytest.raises(NoAnswer, match="no answer within 10 s"):
        problem(RemoteEgo(link, timeout=10.0)).evaluate(x)
    assert link.waits == [10.0, 10.0]


def test_time_outs_stand_behind_an_address() -> None:
    assert parse_address("tcp://host:1") == ("tcp://host:1", {})
    assert parse_address("ipc:///tmp/a?timeout=2.5&patience=7") == ("ipc:///tmp/a", {"timeout": 2.5, "patience": 7.0})
    for wrong in ("?timeuot=3", "?timeout=0", "?timeout=-1", "?timeout=x", "?timeout", "?timeout=nan", "?patience=1e7"):
        with pytest.raises(ValueError, match="timeout=SECONDS"):
            parse_address(f"tcp://host:1{wrong}")
