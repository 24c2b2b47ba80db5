"""Errors in one line, answers as one JSON object."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from rare_envs.study.arguments import BadInput
from rare_envs.study.cli.shell import Answer, OneLineErrors, keep_stdout_for_the_answer, signals_as_exceptions
from tests.rare_envs.study.refusals import SMALL, Cli


def test_json_is_one_object_and_nothing_else(cli: Cli, risky: str) -> None:
    result = cli(*SMALL, "--base", risky, "--json")
    answer = json.loads(result.stdout)
    assert 0.01 < answer["interval"][0] < answer["p"] < answer["interval"][1] < 0.1
    assert (answer["n_sim"], answer["n_failures"]) == (2000, round(answer["p"] * 2000))
    assert list(answer["units"]) == ["ego_speed", "lead_speed", "gap"]
    assert len(answer["failures"]) == 10
    assert "2,000 simulations" in result.stderr


def test_what_an_ego_prints_is_no_part_of_the_answer(cli: Cli, here: Path, risky: str) -> None:
    (here / "talking_ego.py").write_text(
        "import egos_here\n"
        "print('says the module')\n"
        "talk = lambda seen: print('says the policy') or egos_here.still(seen)\n"
        "make = lambda: print('says the function') or egos_here.made(talk)()\n"
    )
    result = cli(*SMALL, "--base", risky, "--ego", "talking_ego:make", "--out", "run", "--json")
    assert json.loads(result.stdout)["n_sim"] == 2000
    for speaker in ("module", "function", "policy"):
        assert f"says the {speaker}" in result.stderr


def test_what_is_written_to_the_descriptor_itself_is_no_part_of_the_answer(capfd: pytest.CaptureFixture[str]) -> None:
    with keep_stdout_for_the_answer():
        print("says Python")
        os.write(1, b"says the descriptor\n")
        subprocess.run([sys.executable, "-c", "print('says a child')"], check=True)
    print("the answer")
    os.write(1, b"and its end\n")
    said = capfd.readouterr()
    assert said.out == "the answer\nand its end\n"
    for speaker in ("Python", "the descriptor", "a child"):
        assert f"says {speaker}\n" in said.err


def test_a_signal_that_the_user_has_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    received: list[int] = []
    try:
        with signals_as_exceptions(received):
            os.kill(os.getpid(), signal.SIGHUP)
            with pytest.raises(KeyboardInterrupt, match="ended by SIGTERM"):
                os.kill(os.getpid(), signal.SIGTERM)
        assert received == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(("code", "said"), [(0, ""), (2, "rare-envs: no room\n"), (3, "")])
def test_a_signal_hides_neither_an_answer_nor_an_error(code: int, said: str) -> None:
    app = typer.Typer(cls=OneLineErrors)

    @app.command("other")
    def other() -> None:
        """A second one, so that there is a group."""

    @app.command("answer")
    def answer() -> None:
        """A command in which the signal is caught, as by an ego that catches everything."""
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        if code == 2:
            raise BadInput("no room")
        print("the answer")
        raise typer.Exit(code)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    result = CliRunner().invoke(app, ["answer"])
    assert (result.exit_code, result.stderr) == (code, said)
    assert {number: signal.getsignal(number) for number in before} == before


def test_an_answer_is_printed_to_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    def show(signals: int) -> None:
        print("the beginning")
        for _ in range(signals):
            os.kill(os.getpid(), signal.SIGTERM)
        print("the end")

    with signals_as_exceptions([]):
        Answer({}, lambda: show(1)).print(as_json=False)
        assert capsys.readouterr().out == "the beginning\nthe end\n"
        with pytest.raises(KeyboardInterrupt):
            Answer({}, lambda: show(2)).print(as_json=False)
    assert capsys.readouterr().out == "the beginning\n"


def test_a_signal_after_the_answer_changes_nothing_and_nothing_heavy_is_imported() -> None:
    program = (
        "import atexit, os, signal, sys\n"
        "from rare_envs.study.cli.app import main\n"
        "assert not {'torch', 'highway_env'} & set(sys.modules)\n"
        "for name in ('SIGINT', 'SIGTERM', 'SIGHUP'):\n"
        "    atexit.register(os.kill, os.getpid(), getattr(signal, name))\n"
        "sys.argv = ['rare-envs', '--version']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("rare-envs ")


@pytest.mark.parametrize(
    "left", ["threading.Thread(target=time.sleep, args=(99,)).start()", "atexit.register(time.sleep, 99)"]
)
def test_what_an_ego_leaves_behind_does_not_keep_the_command_from_its_end(left: str) -> None:
    program = (
        "import atexit, sys, threading, time\n"
        "from rare_envs.study.cli import app, shell\n"
        f"{left}\n"
        "shell.LINGER = 0.1\n"
        "sys.argv = ['rare-envs', '--version']\n"
        "app.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0 and done.stdout.startswith("rare-envs ")
    assert "something that the ego started does not end" in done.stderr
