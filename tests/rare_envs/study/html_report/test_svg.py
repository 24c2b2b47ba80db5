from __future__ import annotations

import re
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from rare_envs.study.html_report.figures import FORMATS, FigureOfPage


def draw(figure: Figure) -> None:
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], label="f <= 0 & more")
    axes.legend()


def test_two_figures_of_a_page_share_no_id_and_each_refers_to_its_own() -> None:
    one, other = (FigureOfPage(name, "A line & <more>.", draw, (4, 3)).to_svg() for name in ("one", "other"))
    ids = [set(re.findall(r'\bid="([^"]+)"', text)) for text in (one, other)]
    assert ids[0] and not ids[0] & ids[1]
    assert set(re.findall(r'href="#([^"]+)"', one)) | set(re.findall(r"url\(#([^)]+)\)", one)) <= ids[0]


def test_it_has_the_width_of_its_place_and_text_as_text() -> None:
    text = FigureOfPage("line", 'A "line" <here>.', draw, (4, 3)).to_svg()
    head = text[: text.index(">")]
    assert " width=" not in head and " height=" not in head and "viewBox" in head
    assert 'aria-label="A &quot;line&quot; &lt;here&gt;."' in head and "<metadata" not in text
    assert "f &lt;= 0 &amp; more" in text


def test_a_form_for_narrow_screens_stands_beside_the_wide_one() -> None:
    text = FigureOfPage("line", "A line.", draw, (8, 3), narrow=(draw, (4, 6))).to_svg()
    heads = re.findall(r'<svg class="(\w+)".*?viewBox="0 0 (\d+)', text)
    assert heads == [("wide", "576"), ("narrow", "288")]
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("kind", FORMATS)
def test_files_are_of_the_kind_asked_for(tmp_path: Path, kind: str) -> None:
    path = FigureOfPage("line", "A line.", draw, (4, 3)).save(tmp_path, kind)
    assert path.name == f"line.{kind}"
    assert path.read_bytes().startswith({"svg": b"<?xml", "pdf": b"%PDF", "png": b"\x89PNG"}[kind])
