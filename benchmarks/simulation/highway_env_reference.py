"""The scenarios played by HighwayEnv's own objects: what parity is tested and speed is measured against."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
from highway_env.envs.common.observation import LidarObservation
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from rare_envs.scenarios.highway import START_LANES

Array = NDArray[np.float64]


class TianVehicle(IDMVehicle):  # type: ignore[misc]
    """HighwayEnv's IDM vehicle with Tian et al.'s parameters, bumper gap and square-root term."""

    ACC_MAX = 5.0
    COMFORT_ACC_MAX = 2.22
    COMFORT_ACC_MIN = -2.4
    DISTANCE_WANTED = 1.0
    TIME_WANTED = 1.2
    DELTA = 4.0

    def lane_distance_to(self, other: Vehicle, lane: object = None) -> float:
        """Bumper to bumper."""
        return float(super().lane_distance_to(other, lane)) - self.LENGTH

    def desired_gap(self, ego_vehicle: Vehicle, front_vehicle: Vehicle = None, projected: bool = True) -> float:
        """Adds s1 sqrt(v / v0)."""
        extra = 2.0 * np.sqrt(ego_vehicle.speed / self.target_speed)
        return float(super().desired_gap(ego_vehicle, front_vehicle, projected)) + extra


class BezierVehicle(Vehicle):  # type: ignore[misc]
    """The cutter: de Casteljau's construction of its path, scalar IDM behind its lead."""

    def __init__(self, road: Road, position: list[float], speed: float, lead: Vehicle) -> None:
        """At rest on its path; the lead is the one it will follow."""
        super().__init__(road, position, 0.0, speed)
        self.start = np.array(position, dtype=float)
        self.path_length = max(4.0 * speed, 15.0)
        self.desired_speed = max(speed, 1.0)
        self.lead = lead

    def act(self, action: object = None) -> None:
        """IDM with respect to the lead."""
        gap = self.lead.position[0] - self.position[0] - self.LENGTH
        closing = self.speed - self.lead.speed * np.cos(self.heading)
        wanted = 1.0 + 2.0 * np.sqrt(self.speed / self.desired_speed) + 1.2 * self.speed
        wanted += self.speed * closing / (2.0 * np.sqrt(2.22 * 2.4))
        ratio = wanted / max(gap, 0.01)
        self.acceleration = max(2.22 * (1.0 - (self.speed / self.desired_speed) ** 4 - ratio**2), -5.0)

    def step(self, dt: float) -> None:
        """Along the curve by the distance covered along the road."""
        x = self.position[0] + self.speed * np.cos(self.heading) * dt
        t = min((x - self.start[0]) / self.path_length, 1.0)
        thirds = self.path_length / 3.0
        points = [np.array([thirds * k, self.start[1] if k < 2 else 0.0]) for k in range(4)]
        while len(points) > 2:
            points = [(1 - t) * a + t * b for a, b in pairwise(points)]
        tangent = points[1] - points[0]
        self.position = np.array([x, ((1 - t) * points[0] + t * points[1])[1]])
        self.heading = float(np.arctan2(tangent[1], tangent[0]))
        self.speed = max(self.speed + self.acceleration * dt, 0.0)
        self.on_state_update()


def _road(lanes: int) -> Road:
    network = RoadNetwork.straight_road_network(lanes, start=-100.0, length=20_000.0, speed_limit=100.0)
    return Road(network, np_random=np.random.RandomState(0))


def car_following_road(x: Array, ego: type[IDMVehicle] = TianVehicle, target_speed: float = 21.72) -> Road:
    """Road with ego and lead.

    Args:
        x: ego_speed, lead_speed, gap; shape (3,).
        ego: Class of the ego.
        target_speed: Its desired speed [m/s].
    """
    road = _road(1)
    lead = Vehicle(road, [x[2] + Vehicle.LENGTH, 0.0], 0.0, x[1])
    road.vehicles = [
        ego(road, [0.0, 0.0], 0.0, x[0], target_speed=target_speed, enable_lane_change=False),
        lead,
    ]
    return road


def cut_in_road(x: Array, ego: type[IDMVehicle] = TianVehicle, target_speed: float = 21.72) -> Road:
    """Road with ego, cutter and lead.

    Args:
        x: ego_speed, cut_in_speed, lead_speed, cut_in_gap, lead_gap, lateral_offset; shape (6,).
        ego: Class of the ego.
        target_speed: Its desired speed [m/s].
    """
    road = _road(2)
    cutter_x = x[3] + Vehicle.LENGTH
    lead = Vehicle(road, [cutter_x + x[4] + Vehicle.LENGTH, 0.0], 0.0, x[2])
    cutter = BezierVehicle(road, [cutter_x, x[5]], x[1], lead)
    for vehicle in (lead, cutter):
        vehicle.check_collisions = False
    driver = ego(road, [0.0, 0.0], 0.0, x[0], target_speed=target_speed, enable_lane_change=False)
    road.vehicles = [driver, cutter, lead]
    return road


def highway_road(x: Array) -> Road:
    """Six of HighwayEnv's IDM vehicles on six straight lanes, started like ours; only their speed is comparable.

    Args:
        x: Starts with six of each: places along the road, offsets in the lane, headings [deg] and speeds.
    """
    road = _road(len(START_LANES))
    s, t, heading, speed = x[: 4 * len(START_LANES)].reshape(4, len(START_LANES))
    road.vehicles = [
        IDMVehicle(road, [s[j], 4.0 * lane + t[j]], np.deg2rad(heading[j]), speed[j])
        for j, lane in enumerate(START_LANES)
    ]
    return road


def drive_road(road: Road, ticks: int, dt: float = 0.1) -> tuple[Array, bool]:
    """Run HighwayEnv's own loop.

    Args:
        road: Road with vehicles.
        ticks: Number of ticks.
        dt: Tick [s].

    Returns:
        x, y, heading and speed of every vehicle at times 0 to ticks, shape (ticks + 1, N, 4), up to
        and without the first state that HighwayEnv calls crashed; and whether there was one.
    """
    rows = [_state(road)]
    for _ in range(ticks):
        road.act()
        road.step(dt)
        if road.vehicles[0].crashed:
            return np.array(rows), True
        rows.append(_state(road))
    return np.array(rows), False


def drive_looking(road: Road, ticks: int, dt: float = 0.1) -> None:
    """Run HighwayEnv's own loop and let every vehicle measure with HighwayEnv's lidar, 20 beams, at each tick."""
    lidar = LidarObservation(SimpleNamespace(road=road), cells=20, maximum_range=100.0)
    for _ in range(ticks):
        for vehicle in road.vehicles:
            lidar.observer_vehicle = vehicle
            lidar.observe()
        road.act()
        road.step(dt)


def _state(road: Road) -> list[list[float]]:
    return [[*v.position, v.heading, v.speed] for v in road.vehicles]
