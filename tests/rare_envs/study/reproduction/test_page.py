"""The page has the record's numbers in their columns, and escapes what they say."""

from __future__ import annotations

import re

from rare_envs.study.reproduction.page import render_reproduction
from tests.rare_envs.study.reproduction.records import record_by_hand


def rows_of(page: str) -> list[list[str]]:
    rows = re.findall(r"<tr>(.*?)</tr>", page, flags=re.DOTALL)
    return [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, flags=re.DOTALL) for row in rows]


def test_paper_ours_and_difference_stand_side_by_side() -> None:
    rows = rows_of(render_reproduction(record_by_hand(), []))
    assert rows[0][2:] == [
        "quantity",
        "paper",
        "ours",
        "95\xa0% interval",  # a number and its unit stay in one line
        "difference",
        "ours, all simulations",
        "released code",
        "why they differ",
    ]
    assert rows[1] == ["SS", "IDM", "mean of p", "8.00e-04", "6.00e-04", "–", "-25\xa0%", "–", "–", "traffic"]
    assert rows[2] == ["simulations", "–", "4,980", "4,900 to 5,100", "–", "5,500", "–", "–"]
    assert rows[3][-2] == "does &lt;not&gt; run"


def test_on_narrow_screens_every_number_has_its_head_and_empty_cells_are_left_out() -> None:
    page = render_reproduction(record_by_hand(), [])
    assert '<td class="n" data-head="ours, all simulations">5,500</td>' in page
    assert '<td class="words none" data-head="why they differ">–</td>' in page
    assert "td[data-head]:not(.name)::before" in page


def test_the_page_needs_nothing_else_and_has_all_sections() -> None:
    page = render_reproduction(record_by_hand(), [])
    assert not re.search(r"(src|href)=", page)
    assert [f'id="{name}"' in page for name in ("notes", "table9", "findings", "figure9", "made")] == [True] * 5
    assert "rare-envs reproduce paper" in page


def test_the_command_is_the_one_to_paste() -> None:
    command = "rare-envs reproduce okelly2018 --out '5 % of it'"
    assert "&#39;5 % of it&#39;</code>" in render_reproduction({**record_by_hand(), "command": command}, [])


def test_code_in_notes_is_shown_as_code_and_escaped() -> None:
    record = {**record_by_hand(), "notes": ["the ego `a<b>` & others"]}
    assert "<li>the ego <code>a&lt;b&gt;</code> &amp; others</li>" in render_reproduction(record, [])


def test_a_figure_that_is_not_drawn_says_why() -> None:
    record = record_by_hand()
    record["figures"]["figure9"]["caption"] = "Not run yet."
    assert "<p>Not run yet.</p>" in render_reproduction(record, [])
