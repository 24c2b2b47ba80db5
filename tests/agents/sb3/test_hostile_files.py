"""Damaged and hostile files of saved policies: one line each, no code, no crash, bounded memory."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import stable_baselines3 as sb3

from tests.agents.sb3.hostile_files import write_hostile

ROOT = Path(__file__).parents[3]
MOST_GROWTH = 300.0
"""Memory [MB] that one file may take; the good one has 40 kB."""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict[str, Any]], Path]:
    folder = tmp_path_factory.mktemp("hostile")
    mark = folder / "was_here"
    good = folder / "0.zip"
    sb3.PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu").save(good)
    write_hostile(good, folder, mark)
    words = [sys.executable, "-m", "tests.agents.sb3.hostile_files", str(folder)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()], mark


HARMLESS = ("member, class.zip", "settings, text for numbers.zip")
"""Files that may load: what is strange in them is not read."""


def test_every_file_is_refused_in_one_line(outcomes: tuple[list[dict[str, Any]], Path]) -> None:
    found, _ = outcomes
    assert len(found) > 60
    for one in found:
        if one["file"].startswith("broken") or one["file"] in HARMLESS:
            assert one["error"] in ("", "ValueError", "ArchiveTooLarge"), one
        else:
            assert one["error"] in ("ValueError", "ArchiveTooLarge"), one
        assert "\n" not in one["message"], one


def test_none_runs_code(outcomes: tuple[list[dict[str, Any]], Path]) -> None:
    assert not outcomes[1].exists()


def test_none_takes_much_memory(outcomes: tuple[list[dict[str, Any]], Path]) -> None:
    assert not [one for one in outcomes[0] if one["grown"] > MOST_GROWTH]
