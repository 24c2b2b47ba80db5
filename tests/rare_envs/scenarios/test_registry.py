"""The registry: scenarios are imported when they are wanted, and unknown ids and names are told from the known ones."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rare_envs.scenarios.registry import (
    SCENARIOS,
    Registry,
    complete_id,
    env_id_of,
    find_scenario,
    scenario_named,
    split_layout,
)
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


def test_scenarios_by_id_and_by_name_are_the_same() -> None:
    for env_id, name in (("rare_envs/HardBrake-v0", "hard_brake"), ("rare_envs/CutIn-v1", "cut_in")):
        assert find_scenario(env_id) is scenario_named(name) is SCENARIOS[env_id]
        assert scenario_named(name).name == name
    with pytest.raises(
        ValueError, match=r"^Unknown scenario 'cut_ins' \(did you mean 'cut_in'\?\); there are car_foll"
    ):
        scenario_named("cut_ins")


@pytest.mark.parametrize("name", ["CutIn", "cut-in", "cut_in", "cutin", "CutIn-v1", "cut_in-v1", "cut_in_v1"])
@pytest.mark.parametrize("namespace", ["", "rare_envs/", "rare_envs:rare_envs/"])
def test_every_spelling_of_a_name_means_the_same(namespace: str, name: str) -> None:
    assert complete_id(namespace + name) == "rare_envs/CutIn-v1"
    assert find_scenario(namespace + name) is scenario_named(namespace + name) is SCENARIOS["rare_envs/CutIn-v1"]
    assert complete_id("highway") == "rare_envs/Highway-v0"
    assert complete_id("highway-v0") == "highway-v0"  # HighwayEnv's own id
    assert complete_id("cut_in_kinematics") == "rare_envs/CutIn-kinematics-v1"


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("CutInn-v0", r"^Unknown environment 'CutInn-v0' \(did you mean 'rare_envs/CutIn-v0'"),
        ("highways", r"^Unknown environment 'highways'.*; the environments are rare_envs/CarFollowing-v0, rare_envs"),
        (None, "^Unknown environment None; the environments are rare_envs/CarFollowing-v0, "),
        (["rare_envs/CutIn-v0"], r"^Unknown environment \['rare_envs/CutIn-v0'\]"),
        ("rare_envs/CutIn-kinematics-v0", r"here take 'rare_envs/CutIn-v0' with observation 'kinematics' and action '"),
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
        assert scenario_named("cut_in") is SCENARIOS["rare_envs/CutIn-v1"]  # a name keeps its first family of ids
        with pytest.raises(ValueError, match="did you mean 'tests/Crest-v0'"):
            find_scenario(f"{place}:tests/Crests-v0")
    finally:
        del SCENARIOS["tests/Crest-v0"]


def test_an_id_may_lack_its_namespace_unless_two_end_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_scenario("CutIn-v0") is find_scenario("rare_envs/CutIn-v0")
    assert env_id_of("CutIn-v0") == "rare_envs/CutIn-v0" and env_id_of("cut_in") == "rare_envs/CutIn-v1"
    assert split_layout("CutIn-kinematics-v0") == split_layout("rare_envs/CutIn-kinematics-v0")
    assert complete_id("a:CutIn-v0") == "a:CutIn-v0"
    monkeypatch.setitem(SCENARIOS.data, "mine/CutIn-v0", STANDING)
    assert complete_id("CutIn-v0") == "CutIn-v0"
    with pytest.raises(ValueError, match=r"^Unknown environment 'CutIn-v0' \(did you mean '\w+/CutIn-v0'"):
        find_scenario("CutIn-v0")
