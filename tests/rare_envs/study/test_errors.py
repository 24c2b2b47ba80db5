"""Errors in input become one line; folders are made before the work and removed if it fails."""

import os
from pathlib import Path

import pytest

from rare_envs.study.errors import MAX_MESSAGE, BadInput, output_folder


def test_a_message_that_repeats_a_long_value_is_cut_in_its_middle() -> None:
    message = str(BadInput(f"Expected a name, got {'x' * 100_000!r}: use a shorter one."))
    assert MAX_MESSAGE - 10 < len(message) <= MAX_MESSAGE
    assert message.startswith("Expected a name, got 'xx") and message.endswith("xx': use a shorter one.")
    assert str(BadInput("y" * MAX_MESSAGE)) == "y" * MAX_MESSAGE


def test_a_folder_is_there_during_the_work_and_stays(tmp_path: Path) -> None:
    with output_folder(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b").is_dir()
    assert (tmp_path / "a" / "b").is_dir()


def test_a_folder_that_cannot_be_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="there is a file of that name"), output_folder(tmp_path / "file"):
        pass
    if os.getuid():  # the superuser may write everywhere
        (tmp_path / "locked").mkdir(mode=0o500)
        with pytest.raises(BadInput, match="Cannot"), output_folder(tmp_path / "locked"):
            pass
