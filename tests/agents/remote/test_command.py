"""The command `python -m agents.remote`: bad input is one line and exit code 2."""

from __future__ import annotations

import sys

import pytest

pytest.importorskip("zmq", reason="the extra remote is optional")

from agents.remote.__main__ import main


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("idm", "needs more than observations"),
        ("imitation --bind tcp://*:5555", "set a shared secret"),
        ("imitation --bind tcp://127.0.0.1:port", "Cannot listen"),
        ("imitatoin", "did you mean 'imitation'"),
        ("", "EGO. See python -m agents.remote --help"),
    ],
)
def test_bad_input_is_one_line(
    words: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["agents.remote", *words.split()])
    with pytest.raises(SystemExit) as stop:
        main()
    shown = capsys.readouterr()
    assert (stop.value.code, shown.out, shown.err.count("\n")) == (2, "", 1)
    assert said in shown.err and shown.err.startswith("agents.remote: ")
