"""Rules of drivers, as compiled rollouts take them."""

import dataclasses

import numpy as np
import pytest

import agents
from rare_envs.control import IDM
from rare_envs.simulation.compiled.highway import read_dense_driver
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import DriverRules, TrafficRules

PLAIN, RULED = (read_dense_driver(agents.load_driver(name)) for name in ("mgail2", "mgail5"))


def test_the_rules_of_a_shipped_driver():
    rules, driver = DriverRules.of(RULED), agents.load_driver("mgail5")
    assert rules.has_close_range and rules.has_changes and rules.avoidance.applies
    assert rules.hard_braking == np.float32(0.75) and rules.eased_beyond == 2.0
    assert rules.greatest_yaw_rate == np.float32(0.3) and rules.least_yaw_rate == -rules.greatest_yaw_rate
    assert np.allclose(rules.changes[:5], driver.changes.coefficients)
    assert rules.changes.waits == 1.0 and np.allclose(rules.changes.edge_margin, driver.changes.waiting.margin)
    assert {type(value) for value in (*rules.close, *rules.changes)} == {np.float32}


def test_rollouts_without_such_rules_are_compiled_without_them():
    assert TrafficRules.of(PLAIN, IDM()) is None and TrafficRules.of(PLAIN, PLAIN) is None


@pytest.mark.parametrize("change", [{"hard_braking": 0.5}, {"close_range": RULED.close_range}])
def test_each_rule_counts(change):
    assert TrafficRules.of(dataclasses.replace(PLAIN, **change), IDM()) is not None


def test_the_ego_has_its_own_rules():
    rules = TrafficRules.of(PLAIN, RULED)
    assert rules.ego.has_close_range and not rules.drivers.has_close_range and not rules.drivers.has_changes
    rules = TrafficRules.of(RULED, PLAIN)
    assert rules.drivers.has_changes and not rules.ego.has_changes and rules.ego.hard_braking == 1.0
