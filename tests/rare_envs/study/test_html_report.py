"""The report of a run: one file with everything in it."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

import rare_envs
from rare_envs.study import BadInput, Question, html_report, prepare, run_into
from rare_envs.study.html_report import find_nearest_event, read_recorded_events, write_html_report
from rare_envs.study.html_report.figures import FigureOfPage
from samplers.output import unfold_rows
from tests.rare_envs.study.fitted_files import write_fitted
from tests.rare_envs.study.refusals import assert_refused

FOLLOWING = "rare_envs/CarFollowing-v0"


@pytest.fixture(scope="session")
def folder(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with failures, and its report."""
    path = shutil.copytree(finished_run, tmp_path_factory.mktemp("runs") / "run")
    write_html_report(path)
    return path


SECTIONS = tuple("answer warnings meaning atlas rates nearest kinds curve parameters intervals levels made".split())
"""Ids of the sections of the page, in their order."""
VOID = {"meta", "br", "img", "link", "path", "use", "rect", "circle", "line", "polygon"}


class Page(HTMLParser):
    """Whether the elements of a page end in the order in which they began."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID and (not self.open or self.open.pop() != tag):
            self.wrong.append(tag)


def ids_of(text: str) -> list[str]:
    return re.findall(r'\sid="([^"]+)"', text)


def test_the_page_is_whole_and_needs_nothing_else(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    page, ids = Page(text), ids_of(text)
    assert page.wrong == [] and page.open == []
    links = re.findall(r'\s(?:src|href|xlink:href|action|data|poster|srcset)\s*=\s*["\']?([^"\'\s>]*)', text)
    assert all(link.startswith(("data:image/gif;base64,", "#")) for link in links) and links
    outside = set(re.findall(r"""(?:https?:)?//[^\s"'<>)]+""", re.sub(r"base64,[A-Za-z0-9+/=]+", "", text)))
    assert all(url.startswith("http://www.w3.org/") for url in outside), outside  # names of namespaces
    assert not re.search("@import|<(script|iframe|link)", text)
    assert len(set(ids)) == len(ids) and [name for name in ids if name in SECTIONS] == list(SECTIONS)
    targets = re.findall(r"(?:href=\"#|url\(#)([^\")]+)", text)
    assert set(targets) <= set(ids) and targets
    assert 'name="viewport"' in text and "@media print" in text and text.startswith("<!DOCTYPE html>")


def test_the_page_says_what_the_files_say(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    result = json.loads((folder / "result.json").read_text())
    assert f"p = {100 * result['p']:.2g}\xa0%" in text  # a number and its unit stay in one line
    whole = unescape(text).replace("\xa0", " ")
    for name, said in unfold_rows(result["text"][1:]):
        assert f"<dt>{name}</dt><dd>{said}</dd>" in whole
    assert "Mode 1: rear-end (ego strikes)" in text
    assert re.search(r"the ego rear-ends the lead after \d\.\d s, at [\d.]+ m/s", text)
    assert "m/s of it, at right angles to what touches" in text and result["proviso"].split(" (")[0] in text
    for name in ("ego_speed [m/s]", "lead_speed [m/s]", "gap [m]"):
        assert name in text
    assert f"rare-envs replay {folder} --failure {result['modes'][0]['failure']}" in text
    for label in ("simulations", "delta-v [m/s]", "time [s]", "ttc [s]", "collision [s]"):
        assert label in text, label  # axes with units, as text
    assert len(re.findall(r"<svg[^>]*aria-label=\"[^\"]+\"", text)) == 6


def test_warnings_come_first_and_text_of_files_is_escaped(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FigureOfPage, "to_svg", lambda _: "")
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    result = json.loads((run / "result.json").read_text())
    coarse = "<script>alert(1)</script> the estimate is imprecise"
    result |= {"warnings": [coarse], "doubts": [coarse], "notes": ["<b>a note</b>"]}
    (run / "result.json").write_text(json.dumps(result))
    text = write_html_report(run)[0].read_text(encoding="utf-8")
    assert "<script>" not in text and "&lt;script&gt;alert(1)&lt;/script&gt; the estimate is imprecise" in text
    assert text.index("the estimate is imprecise") < text.index("How it crashes") < text.index("Kinds of crash")
    assert "&lt;b&gt;a note" in text
    assert "not what the run wrote, by the digests in its study.json: result.json" in text


def test_recorded_events_and_figures_as_files(
    folder: Path, tmp_path: Path, cli: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FigureOfPage, "to_svg", lambda _: "")
    events = tmp_path / "events.csv"
    events.write_text("gap,ego_speed,lead_speed,site\n20,21,10,a\n60,20,20,b\n,1,2,c\n")
    out = tmp_path / "page.html"
    done = cli("report", folder, "--events", events, "--out", out, "--figures", "svg")
    assert done.exit_code == 0, done.stderr
    text = out.read_text(encoding="utf-8")
    assert "nearest recorded" in text and "standard deviations per parameter away" in text
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names >= {"curve.svg", "parameters.svg", "mode1-views.svg"}
    assert all((tmp_path / "figures" / name).read_text().lstrip().startswith("<?xml") for name in names)


def test_a_run_without_failures_has_a_page(tmp_path: Path, safe: str) -> None:
    question = Question(env_id="rare_envs/CarFollowing-v0", base=safe, method="mc", max_sim=50, horizon=1.0)
    run_into(tmp_path / "run", prepare(question))
    text = write_html_report(tmp_path / "run")[0].read_text(encoding="utf-8")
    assert Page(text).wrong == [] and [name for name in ids_of(text) if name in SECTIONS] == list(SECTIONS)
    assert "none in 50 simulations" in text and "No failure was found." in text


@pytest.mark.slow
def test_a_risk_has_one_page_with_the_modes_of_all_scenarios(
    tmp_path: Path, cli: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FigureOfPage, "to_svg", lambda _: "")
    monkeypatch.setattr(html_report, "encode_clip", lambda drive: "")
    bases = {name: write_fitted(tmp_path / f"{name}.json", name) for name in ("hard_brake", "cut_in")}
    rare_envs.risk("idm?max_deceleration=0.5", bases=bases, method="mc", max_sim=400, out=tmp_path / "run")
    done = cli("report", tmp_path / "run")
    assert done.exit_code == 0, done.stderr
    text, total = ((tmp_path / "run" / name).read_text() for name in ("report.html", "risk.json"))
    total = json.loads(total)
    assert Page(text).wrong == [] and len(set(ids_of(text))) == len(ids_of(text))
    assert f"{total['ego']}: collisions per million km " in text
    assert '<a href="#hard_brake-method">hard brake</a>' in text
    modes = [mode for each in total["scenarios"].values() for mode in each["report"]["modes"]]
    assert len(modes) > 1 and text.count("<h3>Mode ") + text.count(" of <code>rare-envs replay") == len(modes)
    shares = [float(share) for share in re.findall(r"([\d.e+]+)\s% of the rate", text)]
    assert shares == sorted(shares, reverse=True) and 90 < sum(shares) < 100.1
    assert_refused(cli("report", tmp_path / "run", "--events", tmp_path / "events.csv"), "one scenario", "risk.json")
    assert_refused(cli("replay", tmp_path / "run"), f"there is one in {tmp_path / 'run' / 'cut_in'}, ")


def test_a_comparison_has_a_page_with_what_each_ego_does(
    tmp_path: Path, risky: str, cli: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FigureOfPage, "to_svg", lambda _: "")
    monkeypatch.setattr(html_report, "encode_clip", lambda drive: "data:image/gif;base64,")
    out, worse = tmp_path / "pair", "idm?max_deceleration=1"
    done = cli("compare", "idm", worse, FOLLOWING, "--base", risky, "--max-sim", 2000, "--out", out, "--method", "mc")
    said = done.stdout.splitlines()[:-1]
    (page,) = write_html_report(out)
    text = unescape(page.read_text(encoding="utf-8")).replace("\xa0", " ")
    assert Page(text).wrong == [] and "\n".join(said) in text
    found, shares = json.loads((out / "comparison.json").read_text()), {}
    for name, percent in re.findall(r'<td class="name">(.*? fails?)</td><td class="n">([\d.]+)', text):
        shares[name] = float(percent) / 100
    assert sum(shares.values()) == pytest.approx(1.0, rel=0.01)
    assert shares["Both fail"] + shares["Only B fails"] == pytest.approx(found["b"]["p"], rel=0.05)
    assert text.count('<img src="data:image/gif') == 2 * text.count("<article>") >= 4


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ((), "there is no such folder"),
        (("runs/",), "it is empty"),
        (("runs/notes.txt", "runs/b"), "it has b, notes.txt"),
        (("runs",), "it is a file"),
        (("runs/first/result.json",), "there is one in runs/first: give that folder"),
        (("result.json", "runs/"), "there is one in .: give that folder"),
        (("runs/cut_in/journal.bin",), "was stopped: give the same command again"),
    ],
)
def test_what_is_there_instead_of_a_run_is_said(
    here: Path, files: tuple[str, ...], said: str, cli: Callable[..., Result]
) -> None:
    for name in files:
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).mkdir() if name.endswith("/") else (here / name).touch()
    before = sorted(here.rglob("*"))
    assert_refused(cli("report", "runs"), "No finished run in 'runs': expected result.json and failures.csv", said)
    assert sorted(here.rglob("*")) == before


def test_the_nearest_event_is_the_nearest_in_deviations() -> None:
    ordinary = np.array([[0.0, 0.0], [2.0, 20.0]])  # deviations 1 and 10
    found = find_nearest_event(np.array([5.0, 0.0]), np.array([[5.0, 30.0], [3.0, 0.0]]), ordinary)
    assert found.values.tolist() == [3.0, 0.0]  # 2 deviations in one of two parameters, against 3
    assert found.distance == pytest.approx(2 / 2**0.5)
    assert found.rarer == 1.0  # (0, 0) is 3 away from it in one parameter, (2, 20) at least 1 and 2


def test_files_without_such_events_are_refused(tmp_path: Path) -> None:
    for text, message in (
        ("", "Empty CSV file"),
        ("gap\n1\n", "lacks the columns a"),
        ("a,gap\nx,1\n", "could not convert string to float: 'x'"),
        ("a,gap\n,1\n", "no event"),
    ):
        (tmp_path / "events.csv").write_text(text)
        with pytest.raises(BadInput, match=message):
            read_recorded_events(tmp_path / "events.csv", ["a", "gap"])
