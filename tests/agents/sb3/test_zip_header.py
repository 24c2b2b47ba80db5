"""The header of a saved model: its algorithm, and archives that are refused."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import pytest

from agents import load_ego
from agents.sb3.zip_header import (
    CORE_ALGORITHMS,
    find_algorithm,
    find_algorithm_class,
    make_training_stubs,
    read_header,
)

contrib = pytest.importorskip("sb3_contrib", reason="sb3-contrib is optional")


def test_an_archive_that_would_fill_the_memory_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("data", b'{"policy_class": {}}')
        archive.writestr("policy.pth", bytes(65 * 2**20))
    assert path.stat().st_size < 2**20
    for trust in (False, True):
        with pytest.raises(ValueError, match=r"would unpack from 0\.\d to 68 MB"):
            load_ego(path, trust=trust)


@pytest.mark.parametrize(
    ("module", "settings", "expected"),
    [
        ("sb3_contrib.common.recurrent.policies", {"clip_range": 0.2}, "recurrent_ppo"),
        ("sb3_contrib.common.maskable.policies", {"clip_range": 0.2}, "maskable_ppo"),
        ("sb3_contrib.qrdqn.policies", {"exploration_initial_eps": 1.0}, "qrdqn"),
        ("stable_baselines3.common.policies", {"cg_max_steps": 15, "gae_lambda": 1.0}, "trpo"),
        ("mine", {"top_quantiles_to_drop_per_net": 2, "target_entropy": "auto"}, "tqc"),
        ("mine", {"clip_range": 0.2, "gae_lambda": 0.95}, "ppo"),
    ],
)
def test_algorithms_are_told_apart(module: str, settings: dict[str, Any], expected: str) -> None:
    header = {"policy_class": {"__module__": module}, **settings}
    assert find_algorithm(header, Path("ego.zip")) == expected


def test_an_unknown_algorithm_asks_for_its_name() -> None:
    with pytest.raises(ValueError, match=r"Cannot tell which algorithm .* name it with algo: ppo"):
        find_algorithm({"policy_class": {"__module__": "mine"}}, Path("ego.zip"))


def write_zip(path: Path, **members: str) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name.replace("__", "."), content)
    return path


def test_a_header_is_read_without_opening_its_pickles(tmp_path: Path) -> None:
    data = json.dumps({"policy_class": {":serialized:": "not base64, not a pickle"}, "gamma": 0.9})
    path = write_zip(tmp_path / "ego.zip", data=data, policy__pth="", _stable_baselines3_version="2.9.2\n")
    header = read_header(path)
    assert (header["gamma"], header["version"]) == (0.9, "2.9.2")
    assert read_header(io.BytesIO(path.read_bytes()), "a name") == header


@pytest.mark.parametrize(
    ("members", "reason"),
    [
        ({}, "not a Stable-Baselines3 model"),
        ({"data": "{}", "policy__pth": ""}, "not a Stable-Baselines3 model"),
        ({"data": "[1]", "policy__pth": ""}, "not a Stable-Baselines3 model"),
        ({"data": "{", "policy__pth": ""}, "is damaged"),
        ({"data": "[" * 100_000, "policy__pth": ""}, "is damaged"),
    ],
)
def test_other_archives_are_refused(members: dict[str, str], reason: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=reason):
        read_header(write_zip(tmp_path / "ego.zip", **members))


def test_no_zip_is_refused_by_the_name_it_is_given() -> None:
    with pytest.raises(ValueError, match="'my ego' is not a zip file"):
        read_header(io.BytesIO(b"PK\x03\x04 cut short"), "my ego")


def test_a_class_is_found_for_every_algorithm() -> None:
    for name in CORE_ALGORITHMS:
        assert find_algorithm_class(name, Path("ego.zip")).__name__ == name.upper()
    with pytest.raises(ValueError, match=r"Unknown algorithm 'pp0' \(did you mean 'ppo'\?\)"):
        find_algorithm_class("pp0", Path("ego.zip"))


def test_stand_ins_are_fresh_each_time() -> None:
    make_training_stubs()["replay_buffer_kwargs"]["n"] = 1
    assert make_training_stubs()["replay_buffer_kwargs"] == {}
    assert make_training_stubs()["seed"] is None
