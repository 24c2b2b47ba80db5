"""Start of the command line: what a signal says that comes while modules are imported."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rare_envs.startup import end_at_signals, is_command_line

ROOT = Path(__file__).parents[2]
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
SCRIPT = "import sys\nfrom rare_envs.study.cli import main\nsys.exit(main())\n"
"""What pip writes for the command `rare-envs`."""
SIGNAL_AT_IMPORT = """
import os, signal, sys

{before}

class SignalAtImport:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.{signal})

sys.meta_path.insert(0, SignalAtImport())
"""


def start(
    folder: Path, how: str, module: str, name: str, before: str = "pass", words: tuple[str, ...] = ("--version",)
) -> subprocess.CompletedProcess[str]:
    """Run `rare-envs`; it gets a signal when it is about to import a module."""
    (folder / "sitecustomize.py").write_text(SIGNAL_AT_IMPORT.format(module=module, signal=name, before=before))
    (folder / "rare-envs").write_text(SCRIPT)
    program = {"script": [str(folder / "rare-envs")], "module": ["-m", "rare_envs"]}[how]
    return subprocess.run(
        [sys.executable, *program, *words],
        env={"PYTHONPATH": f"{folder}:{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("how", "module", "name"),
    [
        ("script", "numpy", "SIGINT"),
        ("module", "rare_envs.study.cli.app", "SIGHUP"),
        ("module", "torch._C", "SIGTERM"),  # while a command imports it
    ],
)
def test_a_signal_during_an_import_is_one_line(tmp_path: Path, how: str, module: str, name: str) -> None:
    words = ("estimate", "rare_envs/CarFollowing-v0") if module == "torch._C" else ("--version",)
    done = start(tmp_path, how, module, name, words=words)
    code = 128 + getattr(signal, name)
    assert (done.returncode, done.stdout, done.stderr) == (code, "", f"rare-envs: stopped by {name}\n")


def test_a_signal_that_nohup_ignores_stays_ignored(tmp_path: Path) -> None:
    done = start(tmp_path, "module", "gymnasium", "SIGHUP", before="signal.signal(signal.SIGHUP, signal.SIG_IGN)")
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("rare-envs ")


def test_other_programs_keep_their_handlers() -> None:
    before = {name: signal.getsignal(getattr(signal, name)) for name in SIGNALS}
    end_at_signals()  # of pytest, which is not the command line
    assert {name: signal.getsignal(getattr(signal, name)) for name in SIGNALS} == before


def test_the_command_line_is_known_by_its_program(monkeypatch: pytest.MonkeyPatch) -> None:
    for program, found in (
        ("/somewhere/bin/rare-envs", True),
        ("C:/venv/Scripts/rare-envs.exe", True),
        (str(ROOT / "rare_envs/__main__.py"), True),
        ("/somewhere/train.py", False),
        ("/somewhere/__main__.py", False),
    ):
        monkeypatch.setattr(sys, "argv", [program, "list"])
        assert is_command_line() == found, program
    monkeypatch.setattr(sys, "argv", ["-m", "list"])
    for module, found in (("rare_envs", True), ("pytest", False)):
        monkeypatch.setattr(sys, "orig_argv", [sys.executable, "-m", module, "list"])
        assert is_command_line() == found, module
