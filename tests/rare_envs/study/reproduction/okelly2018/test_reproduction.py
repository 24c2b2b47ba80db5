"""The whole reproduction on a problem that costs nothing, and its committed record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rare_envs.study.reproduction.okelly2018 import summary
from rare_envs.study.reproduction.okelly2018.behaviour import RunBehaviour
from rare_envs.study.reproduction.okelly2018.reproduction import reproduce_okelly2018
from rare_envs.study.reproduction.okelly2018.study import HighwayStudy


def test_record_and_page_are_written(
    tiny: HighwayStudy, cheap: Any, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HighwayStudy, "make_problem", lambda self: cheap)
    monkeypatch.setattr(summary, "measure_behaviour", lambda problem, x: RunBehaviour(*np.ones((4, len(x)))))
    record = reproduce_okelly2018(tiny, out, "rare-envs reproduce okelly2018")
    assert json.loads((out / "reproduction.json").read_text()) == record
    page = (out / "reproduction.html").read_text()
    assert page.count("<svg") == 2
    assert "Made: 4,600 of 4,600 rollouts" in page
    assert "The full scale was not run" in page
    assert len(record["findings"]) == 11
