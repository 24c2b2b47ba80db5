"""A cheap problem in the place of the highway, with its columns and its base distribution."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.papers.okelly2018 import findings
from benchmarks.papers.okelly2018 import study as study_module
from benchmarks.papers.okelly2018.scales import StudyScale
from benchmarks.papers.okelly2018.study import HighwayStudy

TINY = StudyScale(naive=1000, iterations=2, draws=300, final=300, own=0, chunk=100)


class CheapHighway:
    """f is small where a neighbour starts beside the ego; no simulation."""

    def __init__(self, problem: Any) -> None:
        self.space, self.base, self.dim = problem.space, problem.base, problem.dim
        self.world, self.driver, self.tile = problem.world, problem.driver, problem.tile
        self.evaluated = 0

    def evaluate(self, x: Any) -> Any:
        self.evaluated += len(x)
        columns = self.space.columns(x)
        distance = np.abs(columns["s"][:, 2] - columns["s"][:, 0])
        return 0.3 + distance / 10.0 + (columns["speed"][:, 0] - 10.0) / 10.0


@pytest.fixture(scope="session")
def highway() -> Any:
    return HighwayStudy().make_problem()


@pytest.fixture
def cheap(highway: Any) -> CheapHighway:
    return CheapHighway(highway)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> HighwayStudy:
    monkeypatch.setitem(study_module.STUDY_SCALES, ("lidar", "small"), TINY)
    monkeypatch.setattr(findings, "RESAMPLES", 99)
    return HighwayStudy()


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "okelly"
