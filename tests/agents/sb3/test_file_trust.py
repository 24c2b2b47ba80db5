"""Files that other users may have written are at risk; those that only their owner can write are not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from agents.sb3.file_trust import TRUST_ADVICE, check_origin, find_origin_risks

pytestmark = pytest.mark.skipif(os.name != "posix", reason="rights of other users are in the mode")


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A file in a folder that only its owner can write to."""
    folder = tmp_path / "folder"
    folder.mkdir(mode=0o755)
    path = folder / "ego.zip"
    path.write_bytes(b"")
    path.chmod(0o644)
    return path


def test_a_file_of_ones_own_is_no_risk(saved: Path) -> None:
    assert find_origin_risks(saved, None, saved.with_name("missing.pkl")) == []
    check_origin(saved)


@pytest.mark.parametrize("what", ["file", "folder"])
def test_what_everybody_may_write_to_is(what: str, saved: Path) -> None:
    place = saved if what == "file" else saved.parent
    place.chmod(0o777)
    (risk,) = find_origin_risks(saved)
    assert repr(str(place)) in risk
    assert "is writable by everybody" in risk
    with pytest.raises(ValueError, match=r"Will not open it: .* is writable by everybody") as refused:
        check_origin(saved)
    assert TRUST_ADVICE in str(refused.value)


def test_a_folder_higher_up_counts_and_is_told_once(saved: Path) -> None:
    other = saved.with_name("vecnormalize.pkl")
    other.write_bytes(b"")
    saved.parent.parent.chmod(0o777)
    (risk,) = find_origin_risks(saved, other)
    assert repr(str(saved.parent.parent)) in risk


def test_a_link_is_as_safe_as_the_file_behind_it(saved: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.zip"
    link.symlink_to(saved)
    assert find_origin_risks(link) == []
    saved.chmod(0o666)
    assert repr(str(saved)) in find_origin_risks(link)[0]


def test_in_a_folder_such_as_tmp_the_owner_counts(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved.parent.chmod(0o1777)
    monkeypatch.setattr("os.getuid", lambda: saved.stat().st_uid)
    assert find_origin_risks(saved) == []
    monkeypatch.setattr("os.getuid", lambda: saved.stat().st_uid + 1)
    root = saved.stat().st_uid == 0  # whose files are trusted by everybody
    assert ["belongs to another user" in risk for risk in find_origin_risks(saved)] == ([] if root else [True])
