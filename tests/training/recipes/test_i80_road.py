"""The road of the I-80 from a survey of it."""

import json
from pathlib import Path

import pytest
import torch

from rare_envs.traffic.road import Road, i80
from training.recipes import i80_road

F64 = torch.float64


def test_command_recovers_a_road_and_names_broken_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A survey drawn from a known road, in a frame of its own."""
    true = Road(tuple(3.6 * (k - 0.5) for k in range(7)), i80().reference_line)
    x = torch.arange(0.0, 700.0, 10.0, dtype=F64)

    def write(name: str, key: str, offsets: list[float]) -> None:
        rows = [f"{key},x,y"]
        for number, y in enumerate(offsets):
            east, south, _ = true.to_world(x, torch.full_like(x, y), x)
            rows += [f"{number},{-e:.6f},{s:.6f}" for e, s in zip(east.tolist(), south.tolist(), strict=True)]
        (tmp_path / name).write_text("\n".join(rows))

    write("lanes.csv", "lane", [true.centre(k) for k in reversed(range(6))])
    write("boundaries.csv", "boundary", list(reversed(true.edges[:-1])))
    i80_road.main(tmp_path, tmp_path / "road.json")
    table = json.loads((tmp_path / "road.json").read_text())
    assert table["edges"] == pytest.approx(true.edges, abs=0.002)
    assert true.reference_line is not None
    assert table["curvature"] == pytest.approx(true.reference_line.curvature, abs=1e-6)
    assert capsys.readouterr().out.count(" m rms") == 2
    with pytest.raises(ValueError, match=r"lanes.csv lacks the columns boundary"):
        i80_road.read_lines(tmp_path / "lanes.csv", "boundary")
