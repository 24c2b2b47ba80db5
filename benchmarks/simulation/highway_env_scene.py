"""A scene of ours inside a HighwayEnv environment: its observation, its controlled vehicle, our other vehicles."""

from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)
import numpy as np
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

Array = NDArray[np.float64]


class ReplayedVehicle(Vehicle):  # type: ignore[misc]
    """A vehicle that follows a given track: x, y, heading and speed at each tick, shape (T + 1, 4)."""

    def __init__(self, road: Road, track: Array) -> None:
        """At the start of its track."""
        super().__init__(road, track[0, :2], track[0, 2], track[0, 3])
        self.track, self.tick, self.check_collisions = track, 0, False

    def step(self, dt: float) -> None:
        """To the next point of the track."""
        self.tick += 1
        x, y, self.heading, self.speed = self.track[min(self.tick, len(self.track) - 1)]
        self.position = np.array([x, y])
        self.on_state_update()


class HighwayEnvScene:
    """A straight road of HighwayEnv with an `MDPVehicle` and vehicles that are played; 10 Hz, decisions at 1 Hz."""

    def __init__(self, lanes: int, tracks: Array, ego: int = 0, frequency: int = 10) -> None:
        """Build it.

        Args:
            lanes: Of 4 m, the first at y = 0.
            tracks: x, y, heading and speed of every vehicle, shape (T + 1, N, 4); the ego's start only is used.
            ego: Which of them is controlled.
            frequency: Of the simulation [Hz].
        """
        config = {"lanes_count": lanes, "vehicles_count": 0, "simulation_frequency": frequency, "policy_frequency": 1}
        self.env: Any = gym.make("highway-v0", config=config).unwrapped
        self.env.reset(seed=0)
        network = RoadNetwork.straight_road_network(lanes, start=-100.0, length=20_000.0, speed_limit=100.0)
        road = self.env.road = Road(network, np_random=np.random.RandomState(0))
        vehicles = [ReplayedVehicle(road, tracks[:, j]) for j in range(tracks.shape[1])]
        x, y, heading, speed = tracks[0, ego]
        vehicles[ego] = MDPVehicle(road, [x, y], heading, speed)
        vehicles[ego].check_collisions = False
        road.vehicles = vehicles
        self.env.controlled_vehicles = [vehicles[ego]]
        self.env.define_spaces()  # links observation and action to the vehicle, as the environment's own reset does
        self.states = [self._state()]
        step = road.step

        def recorded(dt: float) -> None:
            step(dt)
            self.states.append(self._state())

        road.step = recorded

    def _state(self) -> list[float]:
        ego = self.env.vehicle
        return [*ego.position, ego.heading, ego.speed]

    def observe(self) -> Array:
        """Return HighwayEnv's current observation, shape (5, 5)."""
        return np.asarray(self.env.observation_type.observe())

    def step(self, action: int) -> Array:
        """Take one decision, which lasts ten ticks, and return the observation after it."""
        return np.asarray(self.env.step(action)[0])
