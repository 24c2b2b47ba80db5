from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

import rare_envs
from rare_envs.study.run_folder import CRASH, read_failures

Cli = Callable[..., Result]
FOLLOWING = "rare_envs/CarFollowing-v0"


def test_a_short_table_needs_no_second_file(cli: Cli, risky: str, tmp_path: Path) -> None:
    (tmp_path / "failures.npz").write_bytes(b"of an earlier run in this folder")
    cli("estimate", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 2000, "--out", tmp_path)
    assert not (tmp_path / "failures.npz").exists()
    found = read_failures(tmp_path)
    assert list(found) == ["ego_speed", "lead_speed", "gap", "f", "log_p0", *CRASH]
    problem = rare_envs.DrivingProblem(FOLLOWING, base=risky)
    x = np.column_stack([found[name] for name in problem.space.names])
    np.testing.assert_array_equal(problem.evaluate(x), found["f"])
    with pytest.raises(FileNotFoundError):
        read_failures(tmp_path / "nowhere")
