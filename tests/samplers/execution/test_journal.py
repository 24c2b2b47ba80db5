"""A run that is killed, or cannot write, comes to the result of an undisturbed one; nobody else's journal is taken."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

import samplers
from samplers.execution import journal as journals
from samplers.execution.journal import JournalFile, JournalRecord, digest_points
from samplers.execution.record_file import MAGIC, JournalError, NothingRecorded, RecordFile
from samplers.problem import FloatArray

F = Callable[[FloatArray], FloatArray]


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
    def __init__(self, f: F = half_space, stop_at: int | None = None) -> None:
        self.f, self.sizes, self.stop_at = f, [], stop_at  # type: ignore[var-annotated]

    def __call__(self, x: FloatArray) -> FloatArray:
        if len(self.sizes) == self.stop_at:
            raise KeyboardInterrupt
        self.sizes.append(len(x))
        return self.f(x)


@pytest.mark.parametrize("method", ["two-stage", "adss", "mc", "ce"])
@pytest.mark.parametrize("f", [half_space, raising])
def test_cut_anywhere_it_comes_to_the_same_result(
    method: str, f: F, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JournalFile, "_elapsed", lambda self: 0.0)
    path = tmp_path / "journal.bin"
    whole = run(None, f, method)
    assert run(path, f, method) == whole
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for length in rng.integers(100, len(content), size=4):
        path.write_bytes(content[:length])
        assert run(path, f, method) == whole
        assert path.read_bytes() == content


def test_a_finished_run_takes_no_simulations_but_those_that_check_f(tmp_path: Path) -> None:
    first = run(tmp_path / "j")
    counted = Counted()
    assert run(tmp_path / "j", counted) == first
    assert counted.sizes == [8]


def test_a_drawn_seed_is_that_of_the_journal(tmp_path: Path) -> None:
    first = run(tmp_path / "j", method="mc", seed=None)
    assert run(tmp_path / "j", method="mc", seed=None) == first
    assert run(tmp_path / "j", method="mc", seed=first.seed) == first


def test_replicates_and_a_longer_run_of_plain_monte_carlo_continue(tmp_path: Path) -> None:
    short = samplers.MonteCarlo(batch=500)
    problem = samplers.FunctionProblem(half_space, 4)
    samplers.estimate(problem, short, seed=1, max_sim=2000, journal=tmp_path / "j")
    counted = Counted()
    longer = samplers.estimate(
        samplers.FunctionProblem(counted, 4), short, seed=1, max_sim=3000, journal=tmp_path / "j"
    )
    assert longer == samplers.estimate(problem, short, seed=1, max_sim=3000)
    assert counted.sizes == [8, 500, 500]


def test_no_journal_is_taken_for_one(tmp_path: Path) -> None:
    (tmp_path / "j").write_bytes(b"x" * 500)
    with pytest.raises(JournalError, match="of another kind"):
        run(tmp_path / "j")
    (tmp_path / "empty").touch()
    assert run(tmp_path / "empty", method="mc").n_sim == 3000
    for payload in (b"[1]", b"{", b"[" * 100_000, b"1" * 5000):
        records = RecordFile(tmp_path / "k", new=True)
        records.clear()
        records.write(payload)
        records.close()
        with pytest.raises(JournalError, match="is no journal"):
            JournalFile.open(tmp_path / "k")
    for batch in (b"", b"{}\n", b'{"points": 1, "notes": {}}\n1234567', b"[1]\n" + bytes(8), b"{" * 10**5 + b"\n"):
        journal = JournalFile.create(tmp_path / "m", {"dim": 4, "seed": 4})
        journal.close()
        records = RecordFile(tmp_path / "m")
        records.mend()
        records.read()
        records.write(batch)
        records.close()
        with pytest.raises(JournalError, match="no journal of this version"):
            run(tmp_path / "m")
        (tmp_path / "m").unlink()


def test_a_journal_that_was_cut_before_its_first_record_is_begun_anew(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole", method="mc")
    JournalFile.create(tmp_path / "head", {"dim": 4, "seed": whole.seed}).close()
    content = (tmp_path / "head").read_bytes()
    for length in (0, 1, len(MAGIC) - 1, len(MAGIC), len(MAGIC) + 5, len(content) - 1):
        path = tmp_path / "cut"
        path.write_bytes(content[:length])
        with pytest.raises(NothingRecorded, match="nothing is recorded in it"):
            JournalFile.open(path)
        path.write_bytes(content[:length])
        assert run(path, method="mc") == whole
        path.write_bytes(content[:length])
        JournalFile.create(path, {}).remove()


def test_creating_replaces_an_empty_journal_alone(tmp_path: Path) -> None:
    path = tmp_path / "j"
    JournalFile.create(path, {"seed": 1}).close()
    journal = JournalFile.create(path, {"seed": 2})
    journal.append(JournalRecord("points", np.ones(3), {}))
    with pytest.raises(JournalError, match="Another process"):
        JournalFile.create(path, {"seed": 3}, replace=True)
    journal.close()
    with pytest.raises(JournalError, match="a journal already"):
        JournalFile.create(path, {"seed": 3})
    replaced = JournalFile.create(path, {"seed": 3}, replace=True)
    assert replaced.read_next() is None
    replaced.remove()
    assert not path.exists()


def test_a_full_disk_ends_nothing_and_what_waits_is_written_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = [False]
    write = RecordFile.write

    def limited(self: RecordFile, payload: bytes) -> None:
        if full[0]:
            raise OSError(28, "No space left on device")
        write(self, payload)

    monkeypatch.setattr(RecordFile, "write", limited)
    calls: list[int] = []

    def f(x: FloatArray) -> FloatArray:
        calls.append(len(x))
        full[0] = 2 <= len(calls) < 5
        return half_space(x)

    method = samplers.MonteCarlo(batch=300)
    with pytest.warns(UserWarning, match=r"Cannot write .*: No space left on device\. .* are lost") as seen:
        result = samplers.estimate(samplers.FunctionProblem(f, 4), method, seed=1, max_sim=3000, journal=tmp_path / "j")
    assert len(seen) == 1
    assert result == samplers.estimate(samplers.FunctionProblem(half_space, 4), method, seed=1, max_sim=3000)
    calls.clear()
    full[0] = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = samplers.estimate(samplers.FunctionProblem(f, 4), method, seed=1, max_sim=3000, journal=tmp_path / "j")
    assert again == result
    assert calls == [8]


def interrupt_at(line: int, call: Callable[[], None]) -> bool:
    """Call, with an interruption before the n-th line that it runs of journals; return whether there was one."""
    left = [line]

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        if Path(frame.f_code.co_filename).name not in ("journal.py", "record_file.py"):
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
    path, records = tmp_path / "journal.bin", [JournalRecord(str(k), np.full(3, float(k)), {}) for k in range(4)]
    for line in itertools.count(1):
        journal = JournalFile.create(path, {}, replace=True)
        journal.append(records[0])
        interrupted = interrupt_at(line, lambda journal=journal: journal.append(records[1]))  # type: ignore[misc]
        taken = journal.n == 6 or not interrupted
        if taken:
            assert journal.flush()
        for record in records[2:]:
            journal.append(record)
        journal.close()
        journal = JournalFile.open(path)
        found = [record.points for record in iter(journal.read_next, None)]
        journal.close()
        assert found in (["0", "1", "2", "3"], *([] if taken else [["0", "2", "3"]])), line
        if not interrupted:
            break
    assert line > 20


def test_what_was_written_is_on_the_disk_within_the_interval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, synced = [0.0], []
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(clock[0]))
    journal = JournalFile.create(tmp_path / "j", {})
    assert len(synced) == 2  # the file and its name
    for now in (0.4, 0.9, 1.1, 1.2, 2.2, 9.0):
        clock[0] = now
        journal.append(JournalRecord("points", np.ones(1), {}))
    assert synced[2:] == [1.1, 2.2, 9.0]
    journal.close()
    assert len(synced) == 6
    assert journals.SYNC_SECONDS == 1.0


def test_the_wall_time_of_all_parts_adds_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records 25 and 60 s after the begin; a part without any; after another boot one 20 s after the resumption."""
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    path, record = tmp_path / "j", JournalRecord("points", np.ones(1), {})

    def go_on(journal: JournalFile, *times: float) -> float:
        earlier = journal.earlier_seconds
        while journal.read_next() is not None:
            pass
        for seconds in times:
            clock[0] += seconds
            journal.append(record)
        clock[0] += 40.0
        journal.close()
        return earlier

    assert go_on(JournalFile.create(path, {}), 25.0, 35.0) == 0.0
    clock[0] += 30.0
    assert go_on(JournalFile.open(path)) == 60.0
    clock[0] = 5.0  # another boot
    assert go_on(JournalFile.open(path), 20.0) == 60.0
    assert go_on(JournalFile.open(path)) == 80.0


@pytest.mark.parametrize("line", [b"", b"{}", b"[]", b"[" * 100_000, b'{"elapsed": null}', b'{"elapsed": NaN}'])
def test_a_record_without_a_time_is_one_of_none(line: bytes, tmp_path: Path) -> None:
    JournalFile.create(tmp_path / "j", {}).close()
    records = RecordFile(tmp_path / "j")
    records.mend()
    records.read()
    records.write(line + b"\n")
    records.close()
    journal = JournalFile.open(tmp_path / "j")
    assert journal.earlier_seconds == 0.0
    journal.close()


def test_points_are_known_by_value_and_shape() -> None:
    x = np.arange(6.0).reshape(3, 2)
    assert digest_points(x) == digest_points(x.copy())
    assert len({digest_points(each) for each in (x, x.reshape(2, 3), x + 1e-15, x[::-1], x.astype("f4"))}) == 5


CHILD = """
import sys, time
import samplers
def f(x):
    time.sleep(0.002)
    return 3.0 - x.sum(axis=1) / x.shape[1] ** 0.5
result = samplers.estimate(samplers.FunctionProblem(f, 4), sys.argv[2], seed=4, max_sim=3000, on_error="bound",
                           journal=sys.argv[1])
print(result.to_json())
"""


def kill_at_random_times(path: Path, method: str, kills: int, rng: np.random.Generator) -> str:
    """Run, kill with SIGKILL once there is a journal and a random time after; return what the last run prints."""
    words = [sys.executable, "-c", CHILD, str(path), method]
    for _ in range(kills):
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        before = path.stat().st_size if path.exists() else 0
        deadline = time.monotonic() + 60
        while not path.exists() or path.stat().st_size <= before:
            if process.poll() is not None or time.monotonic() > deadline:
                break
            time.sleep(0.001)
        time.sleep(float(rng.uniform(0, 0.02)))
        process.send_signal(signal.SIGKILL)
        process.wait()
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("kills", [2, pytest.param(21, marks=pytest.mark.slow)])
def test_killed_at_random_times_it_comes_to_the_same_result(kills: int, tmp_path: Path) -> None:
    method = "mc" if kills == 2 else "two-stage"
    found = kill_at_random_times(tmp_path / "j", method, kills, np.random.default_rng(kills))
    assert found == run(None, method=method).to_json() + "\n"


@pytest.mark.parametrize("mend", [False, True])
def test_a_journal_whose_head_is_damaged_is_left_as_it_is(tmp_path: Path, mend: bool) -> None:
    journal = JournalFile.create(tmp_path / "j", {"dim": 4, "seed": 4})
    journal.append(JournalRecord("of x", np.ones(1000), {}))
    journal.close()
    content = bytearray((tmp_path / "j").read_bytes())
    content[len(MAGIC) + 15] ^= 1
    (tmp_path / "j").write_bytes(content)
    with pytest.raises(JournalError, match="damaged from its first record on") as caught:
        JournalFile.open(tmp_path / "j", mend)
    assert not isinstance(caught.value, NothingRecorded)
    assert (tmp_path / "j").read_bytes() == content
