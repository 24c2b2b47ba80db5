from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rare_envs.study import BadInput
from rare_envs.study.html_report.atlas import find_nearest_event, read_recorded_events


def test_the_nearest_event_is_the_nearest_in_deviations() -> None:
    ordinary = np.array([[0.0, 0.0], [2.0, 20.0]])  # deviations 1 and 10
    found = find_nearest_event(np.array([5.0, 0.0]), np.array([[5.0, 30.0], [3.0, 0.0]]), ordinary)
    assert found.values.tolist() == [3.0, 0.0]  # 2 deviations in one of two parameters, against 3
    assert found.distance == pytest.approx(2 / 2**0.5)
    assert found.rarer == 1.0  # (0, 0) is 3 away from it in one parameter, (2, 20) at least 1 and 2


def test_files_without_such_events_are_refused(tmp_path: Path) -> None:
    for text, message in (
        ("", "columns named as the parameters, a, gap; it has no rows"),
        ("gap\n1\n", "columns named as the parameters, a, gap; it has gap"),
        ("a,gap\nx,1\n", "no table"),
        ("a,gap\n,1\n", "no event"),
    ):
        (tmp_path / "events.csv").write_text(text)
        with pytest.raises(BadInput, match=message):
            read_recorded_events(tmp_path / "events.csv", ["a", "gap"])
