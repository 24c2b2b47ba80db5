"""Files that recipes write: the road of the I-80 from a survey of it, and the model card."""

import json
from pathlib import Path

import pytest
import torch

from agents import LearnedDriver, Provenance, save_driver
from agents.learned.networks import AutoregressiveNoise, Policy, Scaling
from rare_envs.traffic.road import Road, i80
from training.recipes import i80_road
from training.recipes.model_card import format_model_card, main

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


def test_the_card_has_every_driver_with_its_command_metrics_and_licence(tmp_path):
    scaling = Scaling(torch.zeros(51), torch.ones(51), torch.zeros(2), torch.ones(2))
    licence = {"data": "US 101, 3 minutes.", "data_licence": "CC BY-SA 3.0"}
    for kind, metrics, ensemble in (
        ("gail", {"collision": 0.05234567}, {}),
        ("mgail", {"collision": 0.004, "js": {"speed": 0.03}}, {"penalty": 0.5, "tried": [{"penalty": 0.8}]}),
    ):
        about = Provenance(kind=kind, command=f"train {kind}", **licence, metrics=metrics, ensemble=ensemble)
        driver = LearnedDriver(Policy(scaling), colour=AutoregressiveNoise((0.95, 0.0)), name=kind)
        save_driver(driver, about, tmp_path / f"{kind}.safetensors")
    main(tmp_path)
    card = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert card == format_model_card(tmp_path)
    for line in (
        "|  | gail | mgail |",
        "| collision | 0.05235 | 0.004 |",
        "| js speed |  | 0.03 |",
        "| penalty | 0.5 |",
        "| noise, coefficients of lag 1 | 0.95, 0 | 0.95, 0 |",
        "- mgail: `train mgail`",
        "US 101, 3 minutes. Licence of the data and files: CC BY-SA 3.0.",
    ):
        assert line in card.splitlines()
    assert card.count("US 101, 3 minutes.") == 1
    assert "8ect-6jqj" in card
