"""Dockerfile: its user may write where a run leaves its files, and its example writes there."""

from __future__ import annotations

import re
from pathlib import Path

LINES = (Path(__file__).parents[1] / "Dockerfile").read_text(encoding="utf-8").splitlines()


def test_the_folder_of_runs_belongs_to_the_user() -> None:
    instructions = [line for line in LINES if not line.startswith("#")]
    as_root = "\n".join(instructions[: instructions.index("USER $USER_ID")])
    assert re.search(r"mkdir -p /data/runs && chown -R user /data$", as_root, re.MULTILINE)
    assert "WORKDIR /data" in instructions


def test_the_example_writes_where_its_folder_is_mounted() -> None:
    (example,) = (line for line in LINES if line.startswith("#") and "docker run" in line)
    mounted, out = re.search(r'-v "\$PWD/runs:(\S+)"', example), re.search(r" --out (\S+)$", example)
    assert mounted is not None and out is not None
    assert Path("/data", out[1]).is_relative_to(mounted[1])
