"""Dispatch: every chunk is done once, in any order of completion, and only rows that are guilty are lost."""

import threading
from concurrent import futures
from concurrent.futures import Future

import numpy as np
import pytest

from samplers.execution.executors import dispatch
from samplers.execution.executors.base import ExecutorError, WorkerLost
from samplers.execution.executors.chunks import Chunk
from samplers.execution.executors.dispatch import ATTEMPTS, Dispatcher
from samplers.execution.executors.problem_work import ProblemWork

N_ROWS = 24


class Identity:
    dim = 1

    def evaluate(self, x):
        return x[:, 0]


WORK = ProblemWork(Identity(), 0.0, "bound")


class FakePool:
    """Chunks wait until the window is full, or nothing else is submitted, and are done in a random order.

    A chunk with a row that is `deadly` loses its worker, and with `blames` False all others in flight with it.
    """

    workers = 4

    def __init__(self, rng, deadly=(), chance=0.0, blames=True, window=8):
        self.rng, self.deadly, self.chance, self.blames, self.window = rng, set(deadly), chance, blames, window
        self.waiting, self.calls = [], 0

    def submit(self, index, chunk):
        future = LazyFuture(self)
        self.waiting.append((future, chunk))
        self.calls += 1
        assert len(self.waiting) <= self.window
        return future

    def finish_one(self):
        future, chunk = self.waiting.pop(int(self.rng.integers(len(self.waiting))))
        if self.deadly & set(chunk.x[:, 0].tolist()) or self.rng.random() < self.chance:
            lost = [future] if self.blames else [future, *(other for other, _ in self.waiting)]
            if not self.blames:
                self.waiting.clear()
            for each in lost:
                each.set_exception(WorkerLost("killed"))
        else:
            future.set_result(WORK(chunk))


class LazyFuture(Future):
    def __init__(self, pool):
        super().__init__()
        self.pool = pool


@pytest.fixture(autouse=True)
def without_threads(monkeypatch):
    def wait(running, timeout=None, return_when=None):
        next(iter(running)).pool.finish_one()
        done = {future for future in running if future.done()}
        return type("Done", (), {"done": done})

    monkeypatch.setattr("samplers.execution.executors.dispatch.wait", wait)


def run(pool, size=4, work=WORK):
    chunks = Chunk("f", (np.arange(float(N_ROWS))[:, None],)).split(size)
    results, dispatcher = {}, Dispatcher(pool, work)

    def done(number, packed):
        assert number not in results
        results[number] = packed

    dispatcher.run(list(enumerate(chunks)), done, lambda: None)
    return np.concatenate([results[number][0] for number in range(len(chunks))]), dispatcher, results


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("blames", [True, False])
def test_any_order_of_completion_gives_the_same(seed, blames, rng):
    f, dispatcher, _ = run(FakePool(np.random.default_rng(seed), blames=blames))
    np.testing.assert_array_equal(f, np.arange(N_ROWS))
    assert (dispatcher.n_retries, dispatcher.n_lost) == (0, 0)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("blames", [True, False])
@pytest.mark.parametrize("size", [1, 4, 24])
def test_only_deadly_rows_are_lost(seed, blames, size):
    f, dispatcher, results = run(FakePool(np.random.default_rng(seed), {3.0, 17.0}, blames=blames), size)
    expected = np.arange(float(N_ROWS))
    expected[[3, 17]] = np.nan
    np.testing.assert_array_equal(f, expected)
    assert dispatcher.n_lost == 2
    assert sum(len(notes.get("lost", [])) for _, notes in results.values()) == 2


@pytest.mark.parametrize("seed", range(20))
def test_workers_that_are_killed_by_chance_lose_no_row(seed):
    """1 in 20: six in a row, which lose a row of a chunk of 4, have a chance of 6 x 4 / 20^6 = 4e-7 in a run."""
    f, dispatcher, _ = run(FakePool(np.random.default_rng(seed), chance=0.05), 4)
    np.testing.assert_array_equal(f, np.arange(N_ROWS))
    assert dispatcher.n_lost == 0


def test_a_row_is_tried_as_often_as_stated():
    pool = FakePool(np.random.default_rng(0), {3.0}, window=1)
    run(pool, 4)
    assert pool.calls == N_ROWS // 4 - 1 + ATTEMPTS + 3 + ATTEMPTS  # other chunks, its chunk, its neighbours, itself


def test_where_nothing_works_the_run_ends():
    with pytest.raises(ExecutorError, match="No worker has computed anything: killed"):
        run(FakePool(np.random.default_rng(0), set(range(N_ROWS))), 1)


def test_a_deadly_first_row_ends_nothing():
    f, dispatcher, _ = run(FakePool(np.random.default_rng(0), {0.0}, window=1), 1)
    np.testing.assert_array_equal(f[1:], np.arange(1, N_ROWS))
    assert dispatcher.n_lost == 1


def test_what_the_work_raises_ends_the_run():
    class Raising(FakePool):
        def finish_one(self):
            future, _ = self.waiting.pop()
            future.set_exception(ArithmeticError("off the map"))

    with pytest.raises(ArithmeticError, match="off the map"):
        run(Raising(np.random.default_rng(0)))


def test_a_pool_without_workers_is_spoken_of_once(monkeypatch):
    """The two chunks come back after some ten times the time after which a warning is due."""
    monkeypatch.setattr(dispatch, "QUIET_SECONDS", 0.02)
    monkeypatch.setattr(dispatch, "wait", futures.wait)

    class Idle:
        workers, window, blames = 1, 8, True

        def submit(self, index, chunk):
            future = Future()
            threading.Timer(0.2 * (1 + index[0]), lambda: future.set_result(WORK(chunk))).start()
            return future

    results = {}
    chunks = [(number, Chunk("f", (np.full((1, 1), float(number)),))) for number in range(2)]
    with pytest.warns(RuntimeWarning, match="None of 2 chunks has come back in 0.02 s") as caught:
        Dispatcher(Idle(), WORK).run(chunks, results.__setitem__, lambda: None)
    assert len(caught) == 1
    assert sorted(results) == [0, 1]
