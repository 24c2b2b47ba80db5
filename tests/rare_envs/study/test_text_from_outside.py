"""Names and stored texts that steer a terminal, are mathematics to matplotlib or no XML are shown as letters."""

from __future__ import annotations

import shutil
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from typer.testing import CliRunner

from agents.files import SHIPPED
from rare_envs.plugins import clean_text
from rare_envs.study.cli.app import app
from rare_envs.study.plots import saved_figure
from tests.rare_envs.study.refusals import in_file

NAME = "$\\frac{$ [red]\x1b[2J\x1b]0;a\x07\u202e<b>\n"
SHOWN = r"$\frac{$ [red]\x1b[2J\x1b]0;a\x07\u202e<b>"
SMALL = ("estimate", "rare_envs/CarFollowing-v0", "--method", "mc", "--max-sim", "20", *in_file(horizon=0.5))


def assert_plain(text: str) -> None:
    assert text == clean_text(text)


@pytest.mark.slow
def test_a_run_of_a_file_with_a_strange_name_is_shown_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(SHIPPED / "gail.safetensors", f"{NAME}.safetensors")
    folder = tmp_path / f"run {NAME}"
    for words in (
        (*SMALL, "--gamma", "12", "--ego", f"{NAME}.safetensors", "--out", str(folder)),
        ("report", str(folder), "--figures", "svg"),
        ("corpus", "add", str(folder), "--limit", "1"),
        ("corpus", "run", "--ego", f"{NAME}.safetensors", "--junit", "junit.xml"),
        ("replay", f"no {NAME}"),
        ("check-ego", f"no {NAME}", "rare_envs/CarFollowing-v0"),
    ):
        result = CliRunner().invoke(app, list(words))
        assert isinstance(result.exception, SystemExit | None), repr(result.exception)
        assert_plain(result.output)
    assert (folder / "answer.png").exists()
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert_plain(page)
    assert SHOWN.replace("<b>", "&lt;b&gt;") in page
    for path in (Path("junit.xml"), *folder.glob("figures/*.svg")):
        ET.parse(path)


def test_a_picture_that_cannot_be_drawn_is_a_warning(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with saved_figure(tmp_path / "good.png", 2) as figure:
            figure.suptitle(NAME + "漢字 $")
            figure.subplots().set(xlabel=NAME, yscale="log")
    assert (tmp_path / "good.png").exists()
    with pytest.warns(UserWarning, match=r"bad.png is missing, it cannot be drawn: ArithmeticError: \\x1b"):
        with saved_figure(tmp_path / "bad.png", 2):
            raise ArithmeticError("\x1b")
    assert not (tmp_path / "bad.png").exists()
