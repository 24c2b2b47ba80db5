"""Modules of a user by name: found in the working directory, and every way to fail is one line."""

import signal
import sys
from pathlib import Path

import pytest

from rare_envs.plugins import CodeEnded, as_errors, did_you_mean, import_module, import_object


@pytest.fixture
def own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "plugin_of_this_test.py").write_text(
        "nothing = None\nclass Box:\n    pass\ndef make():\n    return 7\n"
    )
    (tmp_path / "exits_in_this_test.py").write_text("import sys\nsys.exit('usage:\\n this')\n")
    monkeypatch.chdir(tmp_path)
    return "plugin_of_this_test"


def test_objects_come_from_the_working_directory(own_module: str) -> None:
    before = list(sys.path)
    assert import_object(f"{own_module}:make", "this test")() == 7
    assert import_object(f"{own_module}:nothing", "this test") is None  # what is there is found, whatever it is
    assert import_module(own_module, "this test").Box.__name__ == "Box"
    assert sys.path == before


def test_what_cannot_be_imported_is_one_line(own_module: str) -> None:
    before = list(sys.path)
    for spec, message in (
        (f"{own_module}:mak", r"has nothing called 'mak' \(did you mean 'make'\?\)\.$"),
        (f"{own_module}:zzz", r"has nothing called 'zzz'\.$"),
        (
            "no_module_of_this_test:make",
            r"^Cannot import 'no_module_of_this_test' for the ego 'x': ModuleNotFoundError",
        ),
        ("exits_in_this_test:make", r"SystemExit: usage: this\.$"),
        (own_module, f"^Expected module:name for the ego 'x', got '{own_module}'"),
        (":make", "^Expected module:name"),
        (f"{own_module}:", "^Expected module:name"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            import_object(spec, "the ego 'x'")
        assert "\n" not in str(caught.value)
    assert sys.path == before


@pytest.mark.parametrize("other", [KeyboardInterrupt, SystemExit])
def test_an_interruption_by_the_user_that_code_raises_again_stays_one(other: type[BaseException]) -> None:
    def stop(by_user: bool) -> None:
        try:
            if by_user:
                signal.raise_signal(signal.SIGINT)
        finally:
            raise other("stopped")

    with pytest.raises(KeyboardInterrupt), as_errors():
        stop(by_user=True)
    with pytest.raises(CodeEnded), as_errors():
        stop(by_user=False)


def test_names_are_suggested_without_their_namespace() -> None:
    ids = ["rare_envs/CutIn-v0", "rare_envs/Highway-v0"]
    assert did_you_mean("Highway-v1", ids) == " (did you mean 'rare_envs/Highway-v0'?)"
    for name in ("cutin-V0", "RARE_ENVS/CUTIN-V0"):
        assert did_you_mean(name, ids) == " (did you mean 'rare_envs/CutIn-v0'?)"
    assert did_you_mean("TTC", ["ttc", "pet"]) == " (did you mean 'ttc'?)"
    assert did_you_mean("zzz", ids) == ""
