"""The registry: scenarios are imported when they are wanted, and unknown ids and names are told from the known ones."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rare_envs.scenarios.registry import SCENARIOS, Registry, complete_id, env_id_of, find_scenario, split_layout
from tests.rare_envs.scenarios.standing import STANDING

PLACE = "place_of_this_registry_test"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module of the working directory that has one object."""
    (tmp_path / f"{PLACE}.py").write_text("SCENARIO = object()\n")
    monkeypatch.chdir(tmp_path)
    yield PLACE
    sys.modules.pop(PLACE, None)


def test_a_scenario_is_imported_when_it_is_first_asked_for_and_kept(place: str) -> None:
    registry = Registry({"a/B-v0": f"{place}:SCENARIO", "a/C-v0": f"{place}:NOTHING"})
    assert list(registry) == ["a/B-v0", "a/C-v0"] and "a/D-v0" not in registry
    assert place not in sys.modules
    scenario = registry["a/B-v0"]
    assert scenario is sys.modules.pop(place).SCENARIO
    assert registry["a/B-v0"] is scenario
    with pytest.raises(ValueError, match=r"^'place_of_this_registry_test' has nothing called 'NOTHING'"):
        registry["a/C-v0"]
    with pytest.raises(KeyError):
        registry["a/D-v0"]


@pytest.mark.parametrize("name", ["CutIn", "cut-in", "cut_in", "cutin", "CutIn-v1", "cut_in-v1", "cut_in_v1"])
@pytest.mark.parametrize("namespace", ["", "rare_envs/", "rare_envs:rare_envs/"])
def test_every_spelling_of_a_name_means_the_same(namespace: str, name: str) -> None:
    assert env_id_of(namespace + name) == complete_id(namespace + name) == "rare_envs/CutIn-v1"
    assert find_scenario(namespace + name) is SCENARIOS["rare_envs/CutIn-v1"]


def test_a_name_may_have_a_version_and_a_layout() -> None:
    assert [env_id_of(each) for each in ("cut_in-v0", "Hard-Brake", "highway", "cut_in_kinematics")] == [
        *("rare_envs/CutIn-v0", "rare_envs/HardBrake-v0", "rare_envs/Highway-v0", "rare_envs/CutIn-kinematics-v1")
    ]
    assert complete_id("highway-v0") == "highway-v0"  # HighwayEnv's own id
    assert find_scenario("cut_in-kinematics-v0") is SCENARIOS["rare_envs/CutIn-v0"]


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("CutInn-v0", r"^Unknown environment 'CutInn-v0' \(did you mean 'rare_envs/CutIn-v0'"),
        ("highways", r"^Unknown environment 'highways'.*; the environments are rare_envs/CarFollowing-v0, rare_envs"),
        (None, "^Unknown environment None; the environments are rare_envs/CarFollowing-v0, "),
        (["rare_envs/CutIn-v0"], r"^Unknown environment \['rare_envs/CutIn-v0'\]"),
        ("cut_ins", r"^Unknown environment 'cut_ins' \(did you mean 'rare_envs/CutIn-v1'"),
        *(
            (name, rf"rare_envs.highway_env_problem\('{name}', ego=...\)\. The environments here are rare_envs/CarFoll")
            for name in ("highway-fast-v0", "roundabout-v0")
        ),
    ],
)
def test_unknown_environment(env_id: object, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        find_scenario(env_id)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_an_id_may_name_the_module_that_registers_it(place: str) -> None:
    Path(f"{place}.py").write_text(
        "from rare_envs.scenarios.registry import SCENARIOS\n"
        "SCENARIOS['tests/Crest-v0'] = SCENARIOS['rare_envs/CutIn-v0']\n"
    )
    try:
        assert find_scenario(f"{place}:tests/Crest-v0") is SCENARIOS["rare_envs/CutIn-v0"]
        assert find_scenario("cut_in") is SCENARIOS["rare_envs/CutIn-v1"]
        with pytest.raises(ValueError, match="did you mean 'tests/Crest-v0'"):
            find_scenario(f"{place}:tests/Crests-v0")
    finally:
        del SCENARIOS["tests/Crest-v0"]


def test_a_name_without_namespace_is_ours_or_the_only_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert split_layout("CutIn-kinematics-v0") == split_layout("rare_envs/CutIn-kinematics-v0")
    assert complete_id("a:cut_in-v0") == "a:rare_envs/CutIn-v0"  # the module is still imported first
    for each in ("mine/CutIn-v0", "mine/Bend-v0", "theirs/Bend-v0", "mine/Crest-v2"):
        monkeypatch.setitem(SCENARIOS.data, each, STANDING)
    assert complete_id("cut_in-v0") == "rare_envs/CutIn-v0" and find_scenario("mine/cut-in") is STANDING
    assert complete_id("crest") == "mine/Crest-v2"
    with pytest.raises(ValueError, match=r"^Unknown environment 'bend' \(did you mean '\w+/Bend-v0'"):
        find_scenario("bend")
