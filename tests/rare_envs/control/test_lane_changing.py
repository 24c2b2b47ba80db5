"""MOBIL by pencil and paper and against HighwayEnv's decisions, and IDM + MOBIL as drivers of the traffic."""

import math

import numpy as np
import pytest
import torch
from highway_env.road.road import Road as HighwayRoad
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from rare_envs.control.idm import IDM
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.make import set_up
from rare_envs.traffic.bodies import LaneTraffic, Lead, boxes_overlap
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State, point_mass
from tests.rare_envs.traffic_states import traffic

ROAD, DT = straight(2), 0.1
EGO, SLOW_LEAD = (0.0, 4.0, 0.0, 20.0), (40.0, 4.0, 0.0, 10.0)
PROMPT = LaneChangingDriver(delay=0.0)


def step(driver, state, memory, road=ROAD, driven=1):
    """Move all vehicles by one tick; the first are driven, the others keep their speeds."""
    scene = LaneTraffic.of(state, road)
    action, memory = driver.decide(scene, slice(0, driven), memory, DT)
    action = torch.cat((action, torch.zeros(len(state.x), state.x.shape[1] - driven, 2)), dim=1).to(state.x)
    moved = point_mass(state.x, state.y, state.heading, state.speed, action[..., 0], action[..., 1], DT)
    return State(*moved, state.theta), memory, action


def begin(driver, batch=1, driven=1):
    return driver.begin(torch.zeros(batch, driven, 2, 2))


def test_a_change_from_its_beginning_to_its_end():
    state, memory, across = traffic(EGO, SLOW_LEAD), begin(PROMPT), []
    for _ in range(80):
        state, memory, _ = step(PROMPT, state, memory)
        across.append(state.y[0, 0].item())
    speeds = -np.diff(across) / DT
    assert abs(across[-1]) < 0.01
    assert memory[0, 0, 0] == 1  # lane 0
    assert speeds.max() == pytest.approx(1.0, abs=0.05)  # the heading lags behind while the vehicle speeds up
    assert speeds.min() > -0.05  # it does not swing back


def test_it_brakes_for_the_lead_in_the_old_and_in_the_new_lane():
    scene = traffic((0.0, 3.9, 0.0, 20.0), (60.0, 4.0, 0.0, 15.0), (45.0, 0.0, 0.0, 15.0))
    memory = torch.tensor([[[1.0, 0.0]]])  # on its way to lane 0
    _, _, action = step(LaneChangingDriver(), scene, memory)
    nearer = IDM().acceleration(torch.tensor([20.0]), Lead(torch.tensor([40.0]), torch.tensor([5.0])))
    assert action[0, 0, 0].item() == pytest.approx(nearer.item(), rel=1e-6)
    keeps = torch.tensor([[[2.0, 0.0]]])
    _, _, action = step(LaneChangingDriver(delay=9.0), scene, keeps)
    further = IDM().acceleration(torch.tensor([20.0]), Lead(torch.tensor([55.0]), torch.tensor([5.0])))
    assert action[0, 0, 0].item() == pytest.approx(further.item(), rel=1e-6)


def test_an_unsafe_change_is_taken_back_and_a_safe_one_is_not():
    """Before its centre has crossed the line at y = 2; then it goes on whatever comes."""
    near, under_way = (-8.0, 0.0, 0.0, 28.0), torch.tensor([[[1.0, 0.3]]])
    for y, others, target in ((3.0, [near], 2), (3.0, [], 1), (1.9, [near], 1)):
        _, memory, _ = step(LaneChangingDriver(), traffic((0.0, y, 0.0, 20.0), SLOW_LEAD, *others), under_way)
        assert memory[0, 0, 0] == target


def test_two_who_move_to_one_place_do_not_meet():
    road = straight(3)
    state = traffic((0.0, 0.0, 0.0, 20.0), (0.5, 8.0, 0.0, 20.0), (40.0, 0.0, 0.0, 10.0), (40.0, 8.0, 0.0, 10.0))
    memory, apart = begin(PROMPT, driven=2), []
    for _ in range(60):
        state, memory, _ = step(PROMPT, state, memory, road, driven=2)
        x, y, heading = (field[:, :2] for field in (state.x, state.y, state.heading))
        apart.append(not boxes_overlap(x[:, 1] - x[:, 0], y[:, 1] - y[:, 0], heading[:, 0], heading[:, 1]).item())
    assert all(apart)


def test_behind_a_slow_ego_they_change_lanes_on_the_curve():
    world, _ = set_up("rare_envs/Highway-v0", drivers="idm+mobil", horizon=20.0)
    start = torch.tensor([[120.0, 80.0, 60.0, 100.0, 90.0, 70.0] + [0.0] * 12 + [10.0] + [20.0] * 5])
    episode = world.start(start)
    state = episode.state._replace(y=episode.state.y.clone())
    state.y[0, 1] = state.y[0, 0]  # another one is behind it in its lane
    episode, lane = episode._replace(state=state), episode.road.lane_of(state.y)
    for _ in range(100):
        episode = world.step(episode, torch.zeros(1, 2))
    assert episode.state.speed[0, 0] == 10.0
    assert episode.road.lane_of(episode.state.y)[0, 1] != lane[0, 1]
    assert episode.state.x[0, 1] > episode.state.x[0, 0]  # it has overtaken
    assert not episode.collided.any()


NEAR_LEAD = (30.0, 4.0, 0.0, 10.0)


def choice(*vehicles, lanes=2, **parameters):
    """Incentive and safety of a change of the first vehicle to the left."""
    scene = LaneTraffic.of(traffic(*vehicles), straight(lanes))
    incentive, safe = LaneChangingDriver(**parameters).judge_changes(scene, slice(0, 1), scene.lane)
    return incentive[0, 0, 0].item(), safe[0, 0, 0].item()


def interaction(speed, gap, closing):
    """a_max (s* / gap)^2 of the IDM with its default parameters."""
    wanted = 1 + 2 * math.sqrt(speed / 21.72) + 1.2 * speed + speed * closing / (2 * math.sqrt(2.22 * 2.4))
    return 2.22 * (wanted / gap) ** 2


def test_no_change_that_makes_the_new_follower_brake_too_hard():
    for x, speed, safe in ((-20.0, 25.0, False), (-60.0, 20.0, True)):
        found = choice(EGO, NEAR_LEAD, (x, 0.0, 0.0, speed))
        braking = 2.22 * (1 - (speed / 21.72) ** 4) - interaction(speed, -x - 5, speed - 20)
        assert (braking >= -4.0) == safe
        assert found[0] > 0.1
        assert found[1] == safe


def test_wrong_parameters_are_refused():
    for wrong in ({"safe_deceleration": 0.0}, {"lateral_speed": 0.0}, {"threshold": -0.1}, {"delay": -1.0}):
        with pytest.raises(ValueError, match="Expected a positive safe deceleration"):
            LaneChangingDriver(**wrong)


LANES, VEHICLES, STATES, DESIRED_SPEED = 4, 10, 400, 30.0


@pytest.mark.parametrize("politeness", [0.0, 0.5])
def test_decisions_are_those_of_highway_env(politeness, monkeypatch):
    """400 random states, both sides of one vehicle each, under HighwayEnv's conventions."""
    monkeypatch.setattr(IDMVehicle, "POLITENESS", politeness)  # shipped as 0, which would leave a term untested
    rng = np.random.default_rng(5)
    lane = rng.integers(0, LANES, (STATES, VEHICLES))
    x = rng.uniform(0.0, 150.0, (STATES, VEHICLES))
    y = 4.0 * lane + rng.uniform(-1.9, 1.9, (STATES, VEHICLES))
    heading, speed = rng.uniform(-0.1, 0.1, (STATES, VEHICLES)), rng.uniform(5.0, 30.0, (STATES, VEHICLES))
    state = State(*(torch.from_numpy(part) for part in (x, y, heading, speed)), torch.zeros(STATES, 0))
    idm = IDM.highway_env(DESIRED_SPEED)
    driver = LaneChangingDriver(idm, politeness, 0.2, 2.0, own_safety=False, reach=1.0)
    scene = LaneTraffic.of(state, straight(LANES))
    incentive, safe = driver.judge_changes(scene, slice(0, 1), scene.lane)
    ours = (safe & (incentive >= driver.threshold))[:, 0].numpy()
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
    assert 40 < theirs.sum() < STATES  # of both kinds there are many
    np.testing.assert_array_equal(ours, theirs)
