"""A run that is killed, or cannot write, comes to the result of an undisturbed one; nobody else's journal is taken."""

from __future__ import annotations

import contextlib
import itertools
import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

import samplers
from samplers import journal as journals
from samplers.journal import Journal, JournalError
from samplers.problem import FloatArray, TermGradients, Terms

F = Callable[[FloatArray], FloatArray]
ONE = (np.ones((3, 1)), dict[str, object]())


def half_space(x: FloatArray) -> FloatArray:
    return 3.0 - x.sum(axis=1) / x.shape[1] ** 0.5


def raising(x: FloatArray) -> FloatArray:
    if (x[:, 0] > 2.5).any():
        raise ArithmeticError("off the map")
    return half_space(x)


def run(path: Path | None, f: F = half_space, method: str = "two-stage", **more: object) -> samplers.Estimate:
    arguments = {"seed": 4, "max_sim": 3000, "on_error": "bound", "journal": path, **more}
    return samplers.estimate(samplers.FunctionProblem(f, 4), method, **arguments)  # type: ignore[arg-type]


class Counted:
    """Counts the points of each call, and is interrupted at one of them."""

    def __init__(self, f: F = half_space, stop_at: int | None = None) -> None:
        self.f, self.stop_at = f, stop_at
        self.sizes: list[int] = []

    def __call__(self, x: FloatArray) -> FloatArray:
        if len(self.sizes) == self.stop_at:
            raise KeyboardInterrupt
        self.sizes.append(len(x))
        return self.f(x)


@pytest.mark.parametrize(("method", "f"), [("two-stage", raising), ("adss", half_space), ("mc", raising)])
def test_interrupted_anywhere_it_comes_to_the_same_result(method: str, f: F, tmp_path: Path) -> None:
    whole, counted = run(None, f, method), Counted(f)
    run(None, counted, method)
    for number, stop_at in enumerate((1, len(counted.sizes) // 2, len(counted.sizes) - 1)):
        path = tmp_path / str(number)
        with pytest.raises(KeyboardInterrupt):
            run(path, Counted(f, stop_at), method)
        assert run(path, f, method) == whole


def test_a_finished_run_takes_no_simulations_but_those_that_check_f(tmp_path: Path) -> None:
    first = run(tmp_path / "j", method="mc", seed=None)
    counted = Counted()
    assert run(tmp_path / "j", counted, "mc", seed=None) == first  # of the seed that was drawn
    assert counted.sizes == [8]
    assert run(tmp_path / "j", method="mc", seed=first.seed) == first


def test_a_longer_run_of_plain_monte_carlo_continues(tmp_path: Path) -> None:
    short = samplers.MonteCarlo(batch=500)
    problem = samplers.FunctionProblem(half_space, 4)
    samplers.estimate(problem, short, seed=1, max_sim=2000, journal=tmp_path / "j")
    counted = Counted()
    longer = samplers.estimate(
        samplers.FunctionProblem(counted, 4), short, seed=1, max_sim=3000, journal=tmp_path / "j"
    )
    assert longer == samplers.estimate(problem, short, seed=1, max_sim=3000)
    assert counted.sizes == [8, 500, 500]


def test_what_does_not_belong_to_the_journal_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "j"
    run(path)
    cases: list[tuple[str, dict[str, object]]] = [
        ("begun with seed 4, and this run has 5", {"seed": 5}),
        ("asks for other points", {"method": "ce"}),
        ("asks for other points", {"max_sim": 2999}),
        ("it has changed since", {"f": lambda x: half_space(x) + 0.1}),
    ]
    for words, change in cases:
        with pytest.raises(JournalError, match=words):
            run(path, **change)  # type: ignore[arg-type]
    with pytest.raises(JournalError, match="begun with dim 4, and this run has 3"):
        samplers.estimate(samplers.FunctionProblem(half_space, 3), seed=4, journal=path)
    assert run(path) == run(None)


def test_f_that_is_random_or_differs_by_rounding_can_be_continued(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)

    def noisy(x: FloatArray) -> FloatArray:
        return half_space(x) + 0.3 * rng.standard_normal(len(x))

    first = run(tmp_path / "j", noisy, "mc")
    assert run(tmp_path / "j", noisy, "mc") == first
    exact = run(tmp_path / "k", method="mc")
    assert run(tmp_path / "k", lambda x: half_space(x) * (1 + 1e-4), "mc") == exact


@pytest.mark.parametrize("place", ["freelist", "index", "schema"])
def test_one_byte_beside_the_records_loses_none_of_them(place: str, tmp_path: Path) -> None:
    path, method = tmp_path / "j", samplers.MonteCarlo(batch=500)
    problem = samplers.FunctionProblem(half_space, 4)
    whole = samplers.estimate(problem, method, seed=1, max_sim=3000, journal=path)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        points = connection.execute("SELECT points FROM chunks WHERE id = 3").fetchone()[0].encode()
    content = bytearray(path.read_bytes())
    places = {"freelist": 36, "index": content.rfind(points), "schema": content.find(b"CREATE TABLE")}
    content[places[place]] ^= 0x80
    path.write_bytes(content)
    with pytest.raises(JournalError, match="is damaged"):
        samplers.estimate(problem, method, seed=1, max_sim=3000, journal=path)
    if place == "schema":  # that nothing can be read by
        return
    with contextlib.closing(Journal.open(path, mend=True)) as journal:
        assert journal.n == 3000
    assert samplers.estimate(problem, method, seed=1, max_sim=3000, journal=path) == whole


@pytest.mark.parametrize("cut", [False, True])
def test_a_page_that_is_lost_costs_what_stands_behind_it(cut: bool, tmp_path: Path) -> None:
    path = tmp_path / "j"
    journal = Journal.create(path, {"seed": 1})
    for k in range(40):
        journal.append(str(k), np.full((300, 1), float(k)), {}, 300)
    journal.close()
    content = bytearray(path.read_bytes())
    half = len(content) // 2
    content = content[:half] if cut else content[:half] + bytes(4096) + content[half + 4096 :]
    path.write_bytes(content)
    with pytest.raises(JournalError, match="is damaged: its end is missing" if cut else "is damaged: record"):
        Journal.open(path)
    journal = Journal.open(path, mend=True)
    assert 300 <= journal.n < 12_000 and journal.head == {"seed": 1}
    assert journal.find("0") is not None
    journal.close()


@pytest.mark.parametrize(("n_bytes", "mend"), [(4096, False), (4096, True), (20480, False)])
def test_killed_while_sqlite_copies_its_log_into_the_file_nothing_is_lost(
    n_bytes: int, mend: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first page, which tells the length of the whole file, is copied first."""
    monkeypatch.setattr(journals, "SYNC_SECONDS", np.inf)
    path, killed = tmp_path / "journal.bin", tmp_path / "killed.bin"
    with contextlib.closing(Journal.create(path, {})) as journal:
        for number in range(20):
            journal.append(str(number), np.full((200, 1), number), {}, 200)
        before, log = path.read_bytes(), journals._wal(path).read_bytes()
    after = path.read_bytes()
    assert len(after) > 20480 >= len(before)
    killed.write_bytes(after[:n_bytes] + before[n_bytes:])
    journals._wal(killed).write_bytes(log)
    with contextlib.closing(Journal.open(killed, mend)) as journal:
        assert journal.n == 4000


def test_no_journal_is_taken_for_one(tmp_path: Path) -> None:
    (tmp_path / "text").write_bytes(b"x" * 5000)
    sqlite3.connect(tmp_path / "other").execute("CREATE TABLE chunks (id)").connection.close()
    for name in ("text", "other"):
        with pytest.raises(JournalError, match="of another kind"):
            run(tmp_path / name)
    for name, content in (("empty", b""), ("cut", b"SQLite fo")):
        (tmp_path / name).write_bytes(content)
        assert run(tmp_path / name, method="mc").n_sim == 3000
    for head in ("[1]", "{", "[" * 100_000):
        Journal.create(tmp_path / "k", {}, replace=True).close()
        row = journals._Row(0, "", 0, 0, 0.0, head, b"")
        connection = sqlite3.connect(tmp_path / "k")
        connection.execute("UPDATE chunks SET notes = ?, digest = ?", (head, row.digest))
        connection.commit()
        connection.close()
        with pytest.raises(JournalError, match="is no journal"):
            Journal.open(tmp_path / "k")


@pytest.mark.skipif(os.name != "posix", reason="needs links")
@pytest.mark.parametrize("end", ["", "-wal", "-journal", "-shm"])
def test_nothing_is_written_through_a_journal_that_is_elsewhere_too(end: str, tmp_path: Path) -> None:
    path, beside, other = tmp_path / "journal", tmp_path / f"journal{end}", tmp_path / "other"
    Journal.create(path, {}).close()
    other.write_bytes(path.read_bytes())
    before = other.read_bytes()
    for put in (beside.symlink_to, beside.hardlink_to):
        beside.unlink(missing_ok=True)
        put(other)
        for mend in (False, True):
            with pytest.raises(
                JournalError, match=r"has another name too, .* put a copy|journal', which no run leaves"
            ):
                Journal.open(path, mend)
        with pytest.raises(JournalError, match="There is a journal already"):
            Journal.create(path, {})
    Journal.create(path, {}, replace=True).close()
    assert other.read_bytes() == before and not path.is_symlink()


def test_a_database_that_does_more_than_hold_records_is_no_journal(tmp_path: Path) -> None:
    Journal.create(tmp_path / "journal", {}).close()
    with contextlib.closing(sqlite3.connect(tmp_path / "journal")) as connection:
        connection.execute("CREATE TRIGGER t AFTER INSERT ON chunks BEGIN DELETE FROM chunks WHERE id < 2; END")
    with pytest.raises(JournalError, match="of another kind"):
        Journal.open(tmp_path / "journal")


def test_creating_replaces_an_empty_journal_alone_and_one_process_has_it(tmp_path: Path) -> None:
    path = tmp_path / "j"
    Journal.create(path, {"seed": 1}).close()
    journal = Journal.create(path, {"seed": 2})
    journal.append("points", *ONE, 3)
    for attempt in (lambda: Journal.create(path, {}, replace=True), lambda: Journal.open(path)):
        with pytest.raises(JournalError, match="Another process"):
            attempt()
    journal.close()
    with pytest.raises(JournalError, match="a journal already"):
        Journal.create(path, {"seed": 3})
    replaced = Journal.create(path, {"seed": 3}, replace=True)
    assert (replaced.n, replaced.head) == (0, {"seed": 3})
    replaced.remove()
    assert not list(tmp_path.iterdir())


BEGIN_AND_KILL = """
import os, signal, sys, time
from pathlib import Path
from samplers.journal import Journal

path, begun = Path(sys.argv[1]), time.perf_counter()
Journal.create(path, {}).remove()
seconds = time.perf_counter() - begun
for kill in range(20):
    if not (child := os.fork()):
        Journal.create(path, {})
        signal.pause()
    time.sleep(seconds * kill / 20)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    Journal.create(path, {}).remove()
"""


@pytest.mark.skipif(os.name != "posix", reason="kills")
def test_killed_at_any_time_of_its_beginning_it_can_begin_again(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", BEGIN_AND_KILL, tmp_path / "j"], check=True)


def interrupt_at(line: int, call: Callable[[], None]) -> bool:
    """Call, with an interruption before the n-th line that it runs of journals; return whether there was one."""
    left = [line]

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        if Path(frame.f_code.co_filename) != Path(journals.__file__):
            return None
        left[0] -= event == "line"
        if event == "line" and left[0] == 0:
            sys.settrace(None)
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def test_interrupted_anywhere_in_a_write_each_record_stands_there_once(tmp_path: Path) -> None:
    """A signal that comes while a journal is written is the most likely one: a run writes after each chunk."""
    path = tmp_path / "journal.bin"
    for line in itertools.count(1):
        journal = Journal.create(path, {}, replace=True)
        journal.append("0", *ONE, 3)
        interrupted = interrupt_at(line, lambda journal=journal: journal.append("1", *ONE, 3))  # type: ignore[misc]
        for points in "23":
            journal.append(points, *ONE, 3)
        journal.close()
        journal = Journal.open(path)
        found = [points for points in "0123" if journal.find(points) is not None]
        assert journal.n == 3 * len(found)
        journal.close()
        assert set("023") <= set(found), line
        if not interrupted:
            break
    assert line > 8


def test_the_wall_time_of_all_parts_adds_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records 25 and 60 s after the begin; a part without any; after another boot one 20 s after the resumption."""
    clock, number = [0.0], itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])

    def go_on(journal: Journal, *times: float) -> float:
        for seconds in times:
            clock[0] += seconds
            journal.append(str(next(number)), *ONE, 3)
        clock[0] += 40.0
        journal.close()
        return journal.earlier_seconds

    path = tmp_path / "j"
    assert go_on(Journal.create(path, {}), 25.0, 35.0) == 0.0
    clock[0] += 30.0
    assert go_on(Journal.open(path)) == 60.0
    clock[0] = 5.0  # another boot
    assert go_on(Journal.open(path), 20.0) == 60.0
    assert go_on(Journal.open(path)) == 80.0


class Series:
    """Two half-spaces in 40 dimensions; it counts what it is asked for, and is interrupted at a certain request."""

    dim, gradient_cost, base = 40, 3.0, samplers.distributions.StandardNormal(40)
    normals = np.linalg.qr(np.random.default_rng(0).standard_normal((40, 2)))[0].T

    def __init__(self, last: int = 10**6, shift: float = 0.0) -> None:
        self.requests, self.last, self.shift = 0, last, shift

    def _count(self) -> None:
        self.requests += 1
        if self.requests > self.last:
            raise KeyboardInterrupt

    def evaluate(self, x: FloatArray) -> FloatArray:
        return self.terms(x).f

    def terms(self, x: FloatArray, gamma: float = 0.0) -> Terms:
        self._count()
        values = 3.5 - x @ self.normals.T - self.shift
        return Terms(values.min(axis=1), values, np.zeros(values.shape, dtype=int), gamma, ("left", "right"))

    def gradient(self, x: FloatArray, term: Any, ticks: Any, gamma: float = 0.0) -> TermGradients:
        self._count()
        return TermGradients(-self.normals[term], 2.5 * len(x))


@pytest.mark.parametrize("last", [5, 11])
def test_a_search_by_terms_is_continued_from_its_journal(last: int, tmp_path: Path) -> None:
    """Interrupted at the walks, in a round or at the end; the rest alone is computed, and the result is the same."""
    undisturbed, path = Series(), tmp_path / "j"
    expected = samplers.estimate(undisturbed, seed=1, max_sim=2000)
    assert undisturbed.requests > 11
    with pytest.raises(KeyboardInterrupt):
        samplers.estimate(Series(last), seed=1, max_sim=2000, journal=path)
    for problem, max_sim, words in ((Series(shift=1.0), 2000, "has changed since"), (Series(), 3000, "other points")):
        if last == 5:
            with pytest.raises(JournalError, match=words):
                samplers.estimate(problem, seed=1, max_sim=max_sim, journal=path)
    rest = Series()
    assert samplers.estimate(rest, seed=1, max_sim=2000, journal=path) == expected
    assert rest.requests == undisturbed.requests - last + 1  # f is called once more, to see that it is the same
