"""Settings of an ego in its name."""

from __future__ import annotations

import pytest

import agents
from agents.settings import read_settings
from rare_envs import IDM
from rare_envs.control.human_driver import HumanDriverModel
from rare_envs.egos.human import HumanEgo


def test_numbers_are_of_the_kind_of_the_field() -> None:
    found = read_settings(HumanDriverModel, "reaction_time=1&leaders=2&glances=0")
    assert found == {"reaction_time": 1.0, "leaders": 2, "glances": False}
    assert [type(value) for value in found.values()] == [float, int, bool]
    assert read_settings(IDM, "") == {}


def test_rule_based_egos_with_settings_are_those_drivers() -> None:
    assert agents.load_ego("idm?time_headway=2&desired_speed=30") == IDM(time_headway=2.0, desired_speed=30.0)
    assert agents.load_ego("human?noticing_time=0") == HumanEgo(HumanDriverModel(noticing_time=0.0))
    noisy = agents.load_ego("noisy:idm?time_headway=2?latency=0.3")
    assert (noisy.ego, noisy.stack.latency) == (IDM(time_headway=2.0), 0.3)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("idm?headway=2", r"Unknown setting 'headway' \(did you mean 'time_headway'\?\); expected desired_speed"),
        ("idm?time_headway=long", "time_headway to be a number, got 'long'"),
        ("idm?time_headway=-1", "time_headway to be a finite number >= 0, got '-1'"),
        ("idm?time_headway=nan", "time_headway to be a finite number"),
        ("idm?time_headway=1&time_headway=2", "time_headway once"),
        ("human?leaders=1.5", "leaders to be a whole number"),
        ("human?glances=2", "glances to be 1"),
        ("idm?time_headway", "time_headway to be a number, got ''"),
    ],
)
def test_settings_that_cannot_be_used_are_one_line(spec: str, said: str) -> None:
    with pytest.raises(ValueError, match=said) as refused:
        agents.load_ego(spec)
    assert spec in str(refused.value)
    assert "\n" not in str(refused.value)
