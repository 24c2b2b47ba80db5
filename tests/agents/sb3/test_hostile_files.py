"""Damaged and hostile files of saved policies: one line each, no code, no crash, bounded memory."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import stable_baselines3 as sb3

from tests.agents.sb3.hostile_files import write_hostile

ROOT = Path(__file__).parents[3]
MOST_GROWTH = 300.0
"""Memory [MB] that one file may take; the good one has 40 kB."""


HARMLESS = ("member, class.zip", "settings, text for numbers.zip", "settings, own names.zip")
"""Files that may load: what is strange in them is not read."""


def test_every_file_is_refused_in_one_line_runs_no_code_and_takes_little_memory(tmp_path: Path) -> None:
    folder, mark, good = tmp_path, tmp_path / "was_here", tmp_path / "0.zip"
    sb3.PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu").save(good)
    write_hostile(good, folder, mark)
    words = [sys.executable, "-m", "tests.agents.sb3.hostile_files", str(folder)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    found: list[dict[str, Any]] = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) > 60
    for one in found:
        may_load = one["file"].startswith("broken") or one["file"] in HARMLESS
        assert one["error"] == "ValueError" or (may_load and one["error"] == ""), one
        assert "\n" not in one["message"], one
        assert one["grown"] <= MOST_GROWTH, one
    assert not mark.exists()
