"""A file is replaced whole or not at all, whatever stops the writing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rare_envs.files import MAX_TEXT_BYTES, read_text_file, replace_file, replace_text


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


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_only_ordinary_files_of_a_bounded_size_are_read(tmp_path: Path) -> None:
    pipe, large, text = tmp_path / "pipe", tmp_path / "large", tmp_path / "text"
    os.mkfifo(pipe)
    (tmp_path / "zero").symlink_to("/dev/zero")
    text.write_text("été", encoding="utf-8")
    large.touch()
    os.truncate(large, MAX_TEXT_BYTES + 1)
    assert read_text_file(text) == "été"
    for path in (pipe, tmp_path / "zero", tmp_path):
        with pytest.raises(ValueError, match="is no ordinary file"):
            read_text_file(path)
    with pytest.raises(ValueError, match="268,435,457 bytes, more than 268,435,456"):
        read_text_file(large)
    with pytest.raises(FileNotFoundError):
        read_text_file(tmp_path / "nowhere")
