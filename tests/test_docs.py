"""The code on every page runs as it stands, block after block."""

import re
from pathlib import Path

import gymnasium as gym
import pytest
import torch

import rare_envs
from rare_envs.scenarios.registry import SCENARIOS

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_of_a_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if page.name == "measures.md":
        pytest.importorskip("rtamt", reason="rtamt, for temporal logic, runs on Python 3.11 or older")
    monkeypatch.chdir(tmp_path)
    torch.set_num_threads(1)
    code = blocks(page)
    assert code
    known = set(rare_envs.ENV_IDS)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for number, block in enumerate(code):
        exec(compile(block, f"{page.name}, block {number}", "exec"), namespace)
    for env_id in set(rare_envs.ENV_IDS) - known:  # a page's own scenarios are not there for other tests
        SCENARIOS.remove(env_id)
        del gym.registry[env_id]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_of_a_page(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target
