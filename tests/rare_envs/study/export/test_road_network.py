"""OpenDRIVE: lanes and curve of the road, as a reader of the standard finds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rare_envs.study.export.openscenario import write_road
from rare_envs.traffic.road import Road, i80
from tests.rare_envs.study.export.readers import RoadReader

pytest.importorskip("scenariogeneration", reason='scenariogeneration comes with "rare-envs[export]"')


def test_lanes_of_a_straight_road(tmp_path: Path) -> None:
    write_road(tmp_path / "a.xodr", Road((-2.0, 2.0, 5.5)), -50.0, 150.0, "test")
    road = RoadReader(tmp_path / "a.xodr")
    assert road.length == 200.0 and road.widths == {-1: 4.0, -2: 3.5} and road.offset == 2.0
    assert [road.lane_at(t) for t in (1.9, -1.9, -2.1, -5.4)] == [-1, -1, -2, -2]


@pytest.mark.parametrize("start", [-100.0, 30.0])
def test_the_curve_is_that_of_the_simulation(tmp_path: Path, start: float) -> None:
    write_road(tmp_path / "a.xodr", i80(), start, 900.0, "i80")
    reader = RoadReader(tmp_path / "a.xodr")
    begin = min(start, 0.0)
    along = torch.linspace(begin + 1.0, 890.0, 300, dtype=torch.float64)
    line = i80().reference_line
    assert line is not None
    point = line.at(along)
    s, t, _ = reader.to_road(point.x.numpy(), -point.y.numpy())
    assert np.abs(s + begin - along.numpy()).max() < 1e-3 and np.abs(t).max() < 1e-3
    ends = np.diff(reader.points[:, 1:3], axis=0)
    assert np.hypot(*ends.T).max() < 0.06  # no jump between geometries: points are 5 cm apart
