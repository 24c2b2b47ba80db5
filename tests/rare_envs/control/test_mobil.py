"""MOBIL by pencil and paper, and against HighwayEnv's decisions."""

import math

import numpy as np
import pytest
import torch
from highway_env.road.road import Road as HighwayRoad
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from rare_envs.control.idm import IDM
from rare_envs.control.lane_changing import Mobil
from rare_envs.traffic import straight
from rare_envs.traffic.neighbours import LaneTraffic
from rare_envs.traffic.state import State
from tests.rare_envs.traffic_states import traffic

EGO, SLOW_LEAD = (0.0, 4.0, 0.0, 20.0), (30.0, 4.0, 0.0, 10.0)


def choice(*vehicles, lanes=2, **parameters):
    scene = LaneTraffic.of(traffic(*vehicles), straight(lanes))
    return Mobil(**parameters).choose(scene, slice(0, 1), IDM())


def interaction(speed, gap, closing):
    """a_max (s* / gap)^2 of the IDM with its default parameters."""
    wanted = 1 + 2 * math.sqrt(speed / 21.72) + 1.2 * speed + speed * closing / (2 * math.sqrt(2.22 * 2.4))
    return 2.22 * (wanted / gap) ** 2


def test_no_change_that_makes_the_new_follower_brake_too_hard():
    for x, speed, safe in ((-20.0, 25.0, False), (-60.0, 20.0, True)):
        found = choice(EGO, SLOW_LEAD, (x, 0.0, 0.0, speed))
        braking = 2.22 * (1 - (speed / 21.72) ** 4) - interaction(speed, -x - 5, speed - 20)
        assert (braking >= -4.0) == safe
        assert found.incentive[0, 0, 0] > 0.1
        assert found.safe[0, 0, 0].item() == found.wanted[0, 0, 0].item() == safe


def test_who_is_polite_counts_the_losses_of_others():
    """The changing vehicle gains a little, its new follower loses more, and brakes by less than is safe."""
    scene = (EGO, (60.0, 4.0, 0.0, 17.0), (-26.0, 0.0, 0.0, 20.0))
    own, loss = interaction(20.0, 55.0, 3.0), interaction(20.0, 21.0, 0.0)
    assert 0.1 < own < loss < 4.0
    for politeness in (0.0, 0.25, 1.0):
        found = choice(*scene, politeness=politeness)
        assert found.safe[0, 0, 0]
        assert found.incentive[0, 0, 0].item() == pytest.approx(own - politeness * loss)
    assert choice(*scene, politeness=0.0).wanted[0, 0, 0]
    assert not choice(*scene, politeness=1.0).wanted[0, 0, 0]


def test_the_old_follower_gains():
    """Behind the changing vehicle it keeps 15 m, then 45 m to the old lead: politeness counts the difference."""
    scene = (EGO, SLOW_LEAD, (-20.0, 4.0, 0.0, 20.0))
    gain = interaction(20.0, 15.0, 0.0) - interaction(20.0, 45.0, 10.0)
    selfish, polite = choice(*scene, politeness=0.0), choice(*scene, politeness=1.0)
    assert (polite.incentive - selfish.incentive)[0, 0, 0].item() == pytest.approx(gain)


def test_wrong_parameters_are_refused():
    for wrong in ({"safe_deceleration": 0.0}, {"threshold": -0.1}, {"delay": -1.0}):
        with pytest.raises(ValueError, match="Expected a positive safe deceleration"):
            Mobil(**wrong)


LANES, VEHICLES, STATES, DESIRED_SPEED = 4, 10, 1000, 30.0


@pytest.mark.parametrize("politeness", [0.0, 0.5])
def test_decisions_are_those_of_highway_env(politeness, monkeypatch):
    """1,000 random states, both sides of one vehicle each, under HighwayEnv's conventions; see `Mobil`."""
    monkeypatch.setattr(IDMVehicle, "POLITENESS", politeness)  # shipped as 0, which would leave a term untested
    rng = np.random.default_rng(5)
    lane = rng.integers(0, LANES, (STATES, VEHICLES))
    x = rng.uniform(0.0, 150.0, (STATES, VEHICLES))
    y = 4.0 * lane + rng.uniform(-1.9, 1.9, (STATES, VEHICLES))
    heading, speed = rng.uniform(-0.1, 0.1, (STATES, VEHICLES)), rng.uniform(5.0, 30.0, (STATES, VEHICLES))
    state = State(*(torch.from_numpy(part) for part in (x, y, heading, speed)), torch.zeros(STATES, 0))
    mobil = Mobil(politeness, 0.2, 2.0, own_safety=False, reach=1.0)
    assert Mobil.highway_env() == Mobil(0.0, 0.2, 2.0, own_safety=False, reach=1.0)
    scene = LaneTraffic.of(state, straight(LANES))
    ours = mobil.choose(scene, slice(0, 1), IDM.highway_env(DESIRED_SPEED)).wanted[:, 0].numpy()
    network = RoadNetwork.straight_road_network(LANES, length=10_000.0, speed_limit=None)
    theirs = np.zeros((STATES, 2), dtype=bool)
    for row in range(STATES):
        road = HighwayRoad(network=network, np_random=np.random.RandomState(0))
        road.vehicles = [
            IDMVehicle(road, [x[row, k], y[row, k]], heading[row, k], speed[row, k], target_speed=DESIRED_SPEED)
            for k in range(VEHICLES)
        ]
        own = road.vehicles[0].lane_index
        assert own[2] == lane[row, 0]
        for index in network.side_lanes(own):
            theirs[row, int(index[2] > own[2])] = road.vehicles[0].mobil(index)
    assert 100 < theirs.sum() < STATES  # of both kinds there are many
    np.testing.assert_array_equal(ours, theirs)
