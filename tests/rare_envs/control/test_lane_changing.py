"""IDM + MOBIL as drivers of the traffic: a change from its beginning to its end, safety, and rates."""

import numpy as np
import pytest
import torch

from rare_envs.control.idm import IDM
from rare_envs.control.lane_changing import SETTLED, LaneChangingDriver, Mobil
from rare_envs.make import set_up
from rare_envs.traffic import straight
from rare_envs.traffic.bodies import boxes_overlap
from rare_envs.traffic.neighbours import LaneTraffic, Lead
from rare_envs.traffic.state import State
from rare_envs.traffic.vehicle_models import point_mass
from tests.rare_envs.traffic_states import traffic

ROAD, DT = straight(2), 0.1
EGO, SLOW_LEAD = (0.0, 4.0, 0.0, 20.0), (40.0, 4.0, 0.0, 10.0)
PROMPT = LaneChangingDriver(mobil=Mobil(delay=0.0))


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
    _, _, action = step(LaneChangingDriver(mobil=Mobil(delay=9.0)), scene, keeps)
    further = IDM().acceleration(torch.tensor([20.0]), Lead(torch.tensor([55.0]), torch.tensor([5.0])))
    assert action[0, 0, 0].item() == pytest.approx(further.item(), rel=1e-6)


def test_who_straddles_brakes_for_a_body_in_its_way():
    scene = traffic((0.0, 1.8, 0.0, 20.0), (30.0, 3.6, 0.0, 15.0))  # another lane, 1.8 m aside: 2 m wide bodies meet
    _, _, action = step(LaneChangingDriver(mobil=Mobil(delay=9.0)), scene, torch.tensor([[[1.0, 0.0]]]))
    behind = IDM().acceleration(torch.tensor([20.0]), Lead(torch.tensor([25.0]), torch.tensor([5.0])))
    assert action[0, 0, 0].item() == pytest.approx(behind.item(), rel=1e-6)


def test_an_unsafe_change_is_taken_back_and_a_safe_one_is_not():
    """Before its centre has crossed the line at y = 2; then it goes on whatever comes."""
    near, under_way = (-8.0, 0.0, 0.0, 28.0), torch.tensor([[[1.0, 0.3]]])
    for y, others, target in ((3.0, [near], 2), (3.0, [], 1), (1.9, [near], 1)):
        _, memory, _ = step(LaneChangingDriver(), traffic((0.0, y, 0.0, 20.0), SLOW_LEAD, *others), under_way)
        assert memory[0, 0, 0] == target


def test_a_change_under_way_is_not_reconsidered():
    """The lead that it was begun for speeds away: there is nothing to gain any longer."""
    fast = (40.0, 4.0, 0.0, 30.0)
    _, memory, _ = step(PROMPT, traffic((0.0, 3.0, 0.0, 20.0), fast), torch.tensor([[[1.0, 9.0]]]))
    assert memory[0, 0, 0] == 1
    unsettled = (0.0, SETTLED + 0.1, 0.0, 20.0)
    _, memory, _ = step(PROMPT, traffic(unsettled, (30.0, 0.0, 0.0, 10.0)), torch.tensor([[[1.0, 9.0]]]))
    assert memory[0, 0, 0] == 1  # a slow lead in the new lane does not send it back before it has arrived


def test_two_who_move_to_one_place_do_not_meet():
    road = straight(3)
    state = traffic((0.0, 0.0, 0.0, 20.0), (0.5, 8.0, 0.0, 20.0), (40.0, 0.0, 0.0, 10.0), (40.0, 8.0, 0.0, 10.0))
    memory, apart = begin(PROMPT, driven=2), []
    for _ in range(60):
        state, memory, _ = step(PROMPT, state, memory, road, driven=2)
        x, y, heading = (field[:, :2] for field in (state.x, state.y, state.heading))
        apart.append(not boxes_overlap(x[:, 1] - x[:, 0], y[:, 1] - y[:, 0], heading[:, 0], heading[:, 1]).item())
    assert all(apart)


def test_decisions_come_once_in_the_delay():
    driver = LaneChangingDriver(mobil=Mobil(delay=1.0))
    x, later = (0.0, 0.05), []
    for start in x:
        state, memory = traffic((start, 4.0, 0.0, 20.0), SLOW_LEAD), begin(driver)
        ticks = 0
        while memory[0, 0, 0] != 1:
            state, memory, _ = step(driver, state, memory)
            ticks += 1
        later.append(ticks)
    assert max(later) <= 11
    assert later[0] != later[1]  # (x + y) pi is another phase


def test_a_row_does_not_depend_on_its_batch():
    rng, rows = np.random.default_rng(0), 4
    x, y = rng.uniform(0, 120, (rows, 6)), 4.0 * rng.integers(0, 3, (rows, 6))
    fields = (torch.from_numpy(values) for values in (x, y, 0 * x, rng.uniform(10, 20, (rows, 6))))
    state = State(*fields, torch.zeros(rows, 0))
    alone = [State(*(field[row : row + 1] for field in state)) for row in range(rows)]
    memory, memories = begin(PROMPT, rows, 6), [begin(PROMPT, 1, 6) for _ in range(rows)]
    for _ in range(12):
        state, memory, _ = step(PROMPT, state, memory, straight(3), 6)
        for row in range(rows):
            alone[row], memories[row], _ = step(PROMPT, alone[row], memories[row], straight(3), 6)
    for name in ("x", "y", "speed"):
        together = torch.cat([getattr(part, name) for part in alone])
        torch.testing.assert_close(getattr(state, name), together, rtol=0, atol=0)


SCENES, LANES, ROWS, SECONDS = 10, 4, 11, 30
TRUCKS = (3 * LANES + 2, 5 * LANES + 3, 7 * LANES + 1, 9 * LANES + 3)
"""Slow vehicles, by row and lane."""
RECORDED = (0.025, 0.05)
"""Lane changes per vehicle and 10 s in complete recordings of US 101 and I-80 (NGSIM)."""


def test_thirty_seconds_of_ordinary_traffic_without_a_collision():
    """20 vehicles per km and lane at 15 to 21 m/s, one in eleven of them a truck that keeps 14 m/s."""
    rng, vehicles = np.random.default_rng(3), LANES * ROWS
    driven = vehicles - len(TRUCKS)
    order = [k for k in range(vehicles) if k not in TRUCKS] + list(TRUCKS)
    x = 50.0 * (np.arange(vehicles) // LANES) + rng.uniform(-12.0, 12.0, (SCENES, vehicles))
    y = np.tile(4.0 * (np.arange(vehicles) % LANES), (SCENES, 1))
    speed = rng.uniform(15.0, 21.0, (SCENES, vehicles))
    speed[:, TRUCKS] = 14.0
    fields = (torch.from_numpy(values[:, order]) for values in (x, y, 0 * x, speed))
    state = State(*fields, torch.zeros(SCENES, 0))
    driver, road = LaneChangingDriver(), straight(LANES)
    memory, before, changes = begin(driver, SCENES, driven), road.lane_of(state.y), 0
    pairs = torch.triu_indices(vehicles, vehicles, 1)
    for _ in range(round(SECONDS / DT)):
        state, memory, _ = step(driver, state, memory, road, driven)
        now = road.lane_of(state.y)
        changes += int((now != before).sum())
        before = now
        a, b = pairs
        touching = boxes_overlap(
            state.x[:, b] - state.x[:, a], state.y[:, b] - state.y[:, a], state.heading[:, a], state.heading[:, b]
        )
        assert not touching.any()
        assert not road.off_road(state.y).any()
    rate = changes / (SCENES * driven * SECONDS / 10)
    print(f"{rate:.3f} lane changes per vehicle and 10 s; recorded {RECORDED[0]} to {RECORDED[1]}")
    assert 0.5 * RECORDED[0] < rate < 1.0  # they do change; how often depends on the traffic, see docs/imitation.md


def test_on_the_highway_nothing_of_them_is_part_of_x_and_no_lidar_is_computed():
    world, space = set_up("rare_envs/Highway-v0", drivers="idm+mobil", horizon=6.0)
    assert space.dim == 24
    assert not world.uses_lidar
    x = torch.from_numpy(space.sample(32, np.random.default_rng(0)))
    episode = world.start(x)
    for _ in range(60):
        episode = world.step(episode, torch.zeros(32, 2, dtype=x.dtype))
    road = episode.road
    assert (episode.state.y[:, 1:] - road.centre_of(episode.state.y[:, 1:])).abs().max() < 2.0
    assert not road.off_road(episode.state.y).any()


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


def test_a_lateral_speed_of_0_is_refused():
    with pytest.raises(ValueError, match="positive lateral speed"):
        LaneChangingDriver(lateral_speed=0.0)
