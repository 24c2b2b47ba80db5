"""Records survive what a process and a power cut do to a file, and what else was done to them is noticed."""

from __future__ import annotations

import multiprocessing.synchronize
import time
from pathlib import Path

import numpy as np
import pytest

from samplers.execution.record_file import MAGIC, JournalError, RecordFile

PAYLOADS = [b"first", b"second record", b"", bytes(range(256)), b"last"]
HEADER, DIGEST = 12, 16


@pytest.fixture
def path(tmp_path: Path) -> Path:
    records = RecordFile(tmp_path / "records.bin", new=True)
    records.clear()
    for payload in PAYLOADS:
        records.write(payload)
    records.sync()
    records.close()
    return tmp_path / "records.bin"


def read_all(path: Path, drop: bool = False) -> list[bytes]:
    records = RecordFile(path)
    try:
        records.mend(drop)
        return list(iter(records.read, None))
    finally:
        records.close()


def ends() -> list[int]:
    sizes = [len(MAGIC), *(HEADER + len(payload) + DIGEST for payload in PAYLOADS)]
    return np.cumsum(sizes).tolist()


def test_records_come_back_in_their_order(path: Path) -> None:
    assert read_all(path) == PAYLOADS
    assert path.stat().st_size == ends()[-1]


@pytest.mark.parametrize("length", range(len(MAGIC), ends()[-1], 7))
def test_a_cut_tail_is_dropped_and_the_file_goes_on_from_there(path: Path, length: int) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:length])
    whole = sum(end <= length for end in ends()) - 1
    assert read_all(path) == PAYLOADS[:whole]
    assert path.stat().st_size == ends()[whole]
    records = RecordFile(path)
    records.mend()
    while records.read() is not None:
        pass
    for payload in PAYLOADS[whole:]:
        records.write(payload)
    records.close()
    assert path.read_bytes() == content


def test_zeros_at_the_end_are_a_power_cut(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content + bytes(5000))
    assert read_all(path) == PAYLOADS
    path.write_bytes(content[: ends()[3] + 4] + bytes(ends()[-1] - ends()[3] - 4) + bytes(100))
    with pytest.raises(JournalError, match="record 4 does not match"):  # half a header, then zeros for two records
        read_all(path)
    path.write_bytes(content[: ends()[-2] + 20] + bytes(ends()[-1] - ends()[-2] - 20))
    assert read_all(path) == PAYLOADS[:-1]


def damaged(content: bytes, kind: str) -> bytes:
    first, second = content[ends()[0] : ends()[1]], content[ends()[1] : ends()[2]]
    rest = content[ends()[2] :]
    head = content[: ends()[0]]
    return {
        "hole": head + second + rest,
        "swapped": head + second + first + rest,
        "repeated": head + first + first + second + rest,
        "zeroed": head + first + second[:HEADER] + bytes(len(second) - HEADER) + rest,
        "length": head + b"\xff" + first[1:] + second + rest,
        "foreign": b"\x93NUMPY" + content[6:],
        "empty": b"",
    }[kind]


@pytest.mark.parametrize("kind", ["hole", "swapped", "repeated", "zeroed", "length", "foreign", "empty"])
def test_what_no_power_cut_does_is_refused_and_the_file_left_as_it_is(path: Path, kind: str) -> None:
    content = damaged(path.read_bytes(), kind)
    path.write_bytes(content)
    with pytest.raises(JournalError, match=r"damaged|of another kind|cut at its beginning"):
        read_all(path)
    assert path.read_bytes() == content


def test_records_before_a_damage_can_be_kept(path: Path) -> None:
    path.write_bytes(damaged(path.read_bytes(), "zeroed"))
    assert read_all(path, drop=True) == PAYLOADS[:1]
    assert read_all(path) == PAYLOADS[:1]


@pytest.mark.parametrize("drop", [False, True])
@pytest.mark.parametrize("position", [len(MAGIC) + at for at in (0, 9, HEADER + 2)])
def test_nothing_is_deleted_where_the_first_record_is_damaged(path: Path, position: int, drop: bool) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 4
    path.write_bytes(content)
    with pytest.raises(JournalError, match="damaged from its first record on"):
        read_all(path, drop)
    assert path.read_bytes() == content


def test_every_flipped_bit_is_noticed(path: Path) -> None:
    content = path.read_bytes()
    for position in range(len(content)):
        path.write_bytes(content[:position] + bytes([content[position] ^ 4]) + content[position + 1 :])
        try:
            assert read_all(path) == PAYLOADS[:-1]
            assert position >= ends()[-2]  # of the last record, which is dropped
        except JournalError:
            assert position < ends()[-2] + HEADER


def hold(path: str, ready: multiprocessing.synchronize.Event) -> None:
    _held = RecordFile(Path(path))
    ready.set()
    time.sleep(60)


def test_one_process_alone_has_the_file_until_it_is_killed(path: Path) -> None:
    mine = RecordFile(path)
    with pytest.raises(JournalError, match="Another process is writing"):
        RecordFile(path)
    mine.close()
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=hold, args=(str(path), ready), daemon=True)
    process.start()
    assert ready.wait(60)
    with pytest.raises(JournalError, match="Another process is writing"):
        RecordFile(path, new=True)
    process.kill()
    process.join()
    assert read_all(path) == PAYLOADS


def test_a_failed_write_leaves_nothing_and_the_next_one_follows_the_last_whole_record(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = path.read_bytes()
    records = RecordFile(path)
    records.mend()
    while records.read() is not None:
        pass
    raw = records._file

    class Full:
        def __getattr__(self, name: str) -> object:
            return getattr(raw, name)

        def write(self, part: memoryview) -> int:
            if len(part) < 40:  # a full disk takes a part, then nothing
                raise OSError(28, "No space left on device")
            return raw.write(part[:-30]) or 0

    monkeypatch.setattr(records, "_file", Full())
    with pytest.raises(OSError, match="No space"):
        records.write(bytes(100))
    assert path.read_bytes() == content
    monkeypatch.setattr(records, "_file", raw)
    records.write(b"again")
    records.close()
    assert read_all(path) == [*PAYLOADS, b"again"]


def test_a_file_that_was_removed_is_not_removed_for_its_successor(path: Path) -> None:
    records = RecordFile(path)
    path.unlink()
    path.write_bytes(b"of somebody else")
    records.remove()
    assert path.read_bytes() == b"of somebody else"
