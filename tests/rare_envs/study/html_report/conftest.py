"""A run with failures, and its report."""

from __future__ import annotations

from pathlib import Path

import pytest

from rare_envs.study import Question, prepare, run_into
from rare_envs.study.html_report import write_html_report
from tests.rare_envs.study.conftest import write_base


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with failures, and its report."""
    path = tmp_path_factory.mktemp("runs")
    base = write_base(path / "risky.json", gap=30.0)
    question = Question(
        env_id="rare_envs/CarFollowing-v0", base=str(base), method="is", max_sim=600, horizon=4.0, target_cov=0.2
    )
    run_into(path / "run", prepare(question))
    write_html_report(path / "run")
    return path / "run"
