"""The model card says what the files say."""

import pytest
import torch

from agents import LearnedDriver, Provenance, save_driver
from agents.learned.networks import AutoregressiveNoise, Policy, Scaling
from training.recipes.model_card import format_model_card, main


def test_the_card_has_every_driver_with_its_command_metrics_and_licence(tmp_path):
    scaling = Scaling(torch.zeros(51), torch.ones(51), torch.zeros(2), torch.ones(2))
    for kind, metrics in (("gail", {"collision": 0.05234567}), ("mgail", {"collision": 0.004, "js": {"speed": 0.03}})):
        provenance = Provenance(
            kind=kind,
            command=f"train {kind}",
            data="US 101, 3 minutes.",
            data_licence="CC BY-SA 3.0",
            metrics=metrics,
            ensemble={"penalty": 0.5, "tried": [{"penalty": 0.8}]} if kind == "mgail" else {},
        )
        driver = LearnedDriver(Policy(scaling), colour=AutoregressiveNoise((0.95, 0.0)), name=kind)
        save_driver(driver, provenance, tmp_path / f"{kind}.safetensors")
    main(tmp_path)
    card = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert card == format_model_card(tmp_path)
    for line in (
        "|  | gail | mgail |",
        "| collision | 0.05235 | 0.004 |",
        "| js speed |  | 0.03 |",
        "| penalty |  | 0.5 |",
        "| noise, coefficients of lag 1 | 0.95, 0 | 0.95, 0 |",
        "- mgail: `train mgail`",
        "US 101, 3 minutes. Licence of the data and of these files: CC BY-SA 3.0.",
    ):
        assert line in card.splitlines()
    assert card.count("US 101, 3 minutes.") == 1
    assert "8ect-6jqj" in card


def test_a_folder_without_drivers_has_no_card(tmp_path):
    with pytest.raises(ValueError, match="found none"):
        format_model_card(tmp_path)
