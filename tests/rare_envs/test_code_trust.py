"""Code that a folder names runs if the run was made here, or was trusted with the same content."""

from __future__ import annotations

from pathlib import Path

import pytest

from rare_envs.study.question import check_code_trust, find_module_file, find_notes, note_own_run

QUESTION, CODE, FOLDER = {"ego": "mine:make", "seed": 0}, ["mine:make"], Path("run")


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("first = 1")
    return tmp_path


def is_trusted(question: dict[str, object] = QUESTION) -> bool:
    try:
        check_code_trust(question, CODE, FOLDER, trust=False)
    except ValueError as error:
        assert "\n" not in str(error)
        return False
    return True


def test_a_run_from_elsewhere_is_refused_and_names_its_code(place: Path) -> None:
    with pytest.raises(ValueError, match=r"was not made here.*'mine:make' \(.*mine\.py\).*add --trust"):
        check_code_trust(QUESTION, CODE, FOLDER, trust=False)
    assert not find_notes().exists()


def test_trust_is_asked_for_once_and_again_after_a_change(place: Path) -> None:
    check_code_trust(QUESTION, CODE, FOLDER, trust=True)
    assert is_trusted()
    assert not is_trusted({**QUESTION, "seed": 1})
    (place / "mine.py").write_text("second = 2")
    assert not is_trusted()
    check_code_trust(QUESTION, CODE, FOLDER, trust=True)
    check_code_trust(QUESTION, CODE, FOLDER, trust=True)
    assert is_trusted()
    assert len(find_notes().read_text().split()) == 2


def test_code_of_ones_own_may_change_but_not_its_place(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    note_own_run(QUESTION, CODE)
    (place / "mine.py").write_text("second = 2")
    assert is_trusted()
    received = place / "received"
    received.mkdir()
    (received / "mine.py").write_text("not_mine = 3")
    monkeypatch.chdir(received)
    assert not is_trusted()


def test_modules_are_found_without_running_them(place: Path) -> None:
    (place / "pack" / "inner").mkdir(parents=True)
    (place / "pack" / "__init__.py").write_text("raise SystemExit")
    (place / "pack" / "inner" / "__init__.py").write_text("raise SystemExit")
    assert find_module_file("pack.inner:make") == (place / "pack" / "inner" / "__init__.py").resolve()
    assert find_module_file("no_such_module:make") is None
    assert find_module_file("a\0b:make") is None


def test_trust_holds_for_the_packages_on_the_way_too(place: Path) -> None:
    (place / "outer").mkdir()
    (place / "outer" / "__init__.py").write_text("")
    (place / "outer" / "inner.py").write_text("first = 1")
    question = {"ego": "outer.inner:make"}
    check_code_trust(question, ["outer.inner:make"], FOLDER, trust=True)
    check_code_trust(question, ["outer.inner:make"], FOLDER, trust=False)
    (place / "outer" / "__init__.py").write_text("runs = 'on import'")
    with pytest.raises(ValueError, match="add --trust"):
        check_code_trust(question, ["outer.inner:make"], FOLDER, trust=False)
