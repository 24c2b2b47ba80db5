"""A file is replaced whole or not at all, whatever stops the writing, and read only where its size is bounded."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import samplers
from agents import load_driver, load_ego
from agents.saved_ego import load_statistics
from rare_envs.files import (
    MAX_MEMBERS,
    MAX_VALUES,
    digest_file,
    parse_json_object,
    read_members,
    read_text_file,
    replace_file,
    replace_text,
)
from rare_envs.scenarios import find_scenario
from rare_envs.scenarios.base import load_base
from rare_envs.study.arguments import BadInput, read_question_file
from rare_envs.study.html_report import read_recorded_events
from rare_envs.study.run_folder import read_failures
from training.checkpoints import read_checkpoint
from training.data import load_ngsim


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_error_leaves_the_earlier_file_and_no_draft(error: type[BaseException], tmp_path: Path) -> None:
    path = tmp_path / "ego.zip"
    path.write_bytes(b"earlier")
    with pytest.raises(error), replace_file(path) as draft:
        draft.write_bytes(b"half")
        raise error
    assert path.read_bytes() == b"earlier"
    assert names(tmp_path) == ["ego.zip"]


@pytest.mark.skipif(os.name != "posix", reason="needs links")
def test_what_is_written_replaces_links_and_gives_nobody_more_rights(tmp_path: Path) -> None:
    outside, path = tmp_path / "outside", tmp_path / "report.html"
    outside.write_text("precious")
    (tmp_path / "folder").mkdir()
    path.hardlink_to(outside)
    for target in (outside, tmp_path / "nowhere", tmp_path / "folder"):
        replace_text(path, "new")
        assert path.read_text() == "new" and not path.is_symlink() and outside.read_text() == "precious"
        path.unlink()
        path.symlink_to(target)
    replace_text(path, "new")
    for before, after in ((0o600, 0o600), (0o6777, 0o644)):
        path.chmod(before)
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(tmp_path)
            umask = os.umask(0o022)
            replace_text("report.html", "again")
            os.umask(umask)
        assert path.stat().st_mode & 0o7777 == after
    assert names(tmp_path) == ["folder", "outside", "report.html"] and not names(tmp_path / "folder")


WRITER = """
import sys
from rare_envs.files import replace_text
k = 0
while True:
    k += 1
    replace_text(sys.argv[1], str(k) * 200_000)
    print(flush=True)
"""


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_writer_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    for delay in (0.0, 0.003, 0.011):
        words = [sys.executable, "-c", WRITER, str(path)]
        with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()  # the first file is there
            time.sleep(delay)
            process.send_signal(signal.SIGKILL)
        text = path.read_text()
        number = text[: len(text) // 200_000]
        assert text == number * 200_000


READERS: dict[str, Callable[[Path], Any]] = {
    "text": read_text_file,
    "archive": read_members,
    "digest": digest_file,
    "drivers": load_driver,
    "ego": load_ego,
    "statistics": lambda path: load_statistics(path, None, trust=True),
    "base": lambda path: load_base(find_scenario("cut_in"), path),
    "question": read_question_file,
    "events": lambda path: read_recorded_events(path, ["gap"]),
    "checkpoint": lambda path: read_checkpoint(path, ()),
    "recording": load_ngsim,
    "result": samplers.Estimate.load,
}
"""What reads a file that somebody else may have written."""
REFUSED = (ValueError, BadInput)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_a_device_and_an_enormous_file_are_refused_at_once(name: str, tmp_path: Path) -> None:
    pipe, device, enormous = (tmp_path / f"{kind}.safetensors" for kind in ("pipe", "device", "enormous"))
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    enormous.touch()
    os.truncate(enormous, 40 * 2**30)
    for path in (pipe, device):
        with pytest.raises(REFUSED, match=r"no ordinary file|Cannot resume"):
            READERS[name](path)
    if name == "digest":  # which is of both ends
        return
    with pytest.raises(REFUSED, match=r"42,949,672,960 bytes|not a zip|Cannot read|65,536 letters|Cannot resume"):
        READERS[name](enormous)


def test_what_unpacks_to_far_more_than_its_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "archive.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(MAX_MEMBERS + 1):
            archive.writestr(str(number), b"")
    with pytest.raises(ValueError, match="more than 10,000 members"):
        read_members(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:  # which unpacks before its size is known
        archive.writestr("data", bytes(1000))
    with pytest.raises(ValueError, match="another method than deflate"):
        read_members(path)
    for text in ("[" + "[]," * MAX_VALUES, '{"a": 1' + ',"a":1' * MAX_VALUES):
        with pytest.raises(ValueError, match="the file has more than 500,000 values"):
            parse_json_object(text, "the file")
    (tmp_path / "failures.csv").write_text("," * MAX_VALUES + "\n")
    with pytest.raises(ValueError, match="more than 500,000 cells"):
        read_failures(tmp_path)
    path.write_bytes("\ufeffété".encode())
    assert read_text_file(path) == "été"
