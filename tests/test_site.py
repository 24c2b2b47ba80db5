"""The documentation site: every page has its place in the order to read in, and the index leads to it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
BUILT = {"notice.md", "model_cards.md"}
"""Pages that the build makes of files outside docs/."""
CONFIG = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


def pages_in(nav: list) -> list[str]:
    """Return the pages of a navigation tree, in its order."""
    pages = []
    for entry in nav:
        values = entry.values() if isinstance(entry, dict) else [entry]
        for value in values:
            pages += pages_in(value) if isinstance(value, list) else [value]
    return pages


def test_every_page_is_in_the_navigation_once() -> None:
    there = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}
    pages = pages_in(CONFIG["nav"])
    assert len(pages) == len(set(pages))
    assert set(pages) - BUILT == there


def test_the_sections_come_in_the_order_to_read_in() -> None:
    sections = [name for entry in CONFIG["nav"] for name in entry]
    assert sections == ["Start", "How-to", "Reference", "Explanation", "Results"]


def test_the_index_leads_to_every_page() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    linked = re.findall(r"\]\(([^)#]+\.md)[^)]*\)", index)
    assert set(pages_in(CONFIG["nav"])) - BUILT - {"index.md"} == set(linked)


@pytest.mark.parametrize("package", ["agents", "rare_envs", "samplers", "training"])
def test_the_reference_has_the_public_names_of_a_package(package: str) -> None:
    page = (DOCS / "reference" / f"{package}.md").read_text(encoding="utf-8")
    assert f"\n::: {package}\n" in page


def test_nothing_of_the_site_comes_from_elsewhere() -> None:
    assert CONFIG["theme"]["font"] is False
    assert "extra_javascript" not in CONFIG
    styles = [DOCS / path for path in CONFIG["extra_css"]]
    assert all(path.is_file() and "//" not in path.read_text(encoding="utf-8") for path in styles)  # none of a host
    assert CONFIG["validation"]["links"] == dict.fromkeys(CONFIG["validation"]["links"], "warn")


def test_only_pages_and_pictures_are_copied() -> None:
    assert {"*.py", "__pycache__"} <= set(CONFIG["exclude_docs"].split())  # of docs/site_hooks.py


def readme_lines() -> list[str]:
    return (ROOT / "README.md").read_text(encoding="utf-8").splitlines()


def test_the_first_screen_of_the_readme() -> None:
    """The question, two commands, what they print and the picture; set-up comes before the first table."""
    lines = readme_lines()
    first = "\n".join(lines[:60])
    for part in (
        "**How often would this driving policy crash",
        "$ make demo",
        "$ make test",
        "P[f <= 0] = ",
        "demo.png)",
    ):
        assert part in first
    tables = [number for number, line in enumerate(lines) if line.startswith("|")]
    assert lines.index("## Set-up") < min(tables, default=len(lines))


def test_the_readme_is_short() -> None:
    assert len("\n".join(readme_lines())) < 10_000


def test_pages_of_a_navigation() -> None:
    assert pages_in([{"A": ["a.md", {"B": "b.md"}]}, "c.md"]) == ["a.md", "b.md", "c.md"]
