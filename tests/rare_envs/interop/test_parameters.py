"""Parameters of HighwayEnv's vehicles."""

import highway_env  # noqa: F401  (registers the ids)
from highway_env.vehicle.behavior import IDMVehicle

from tests.rare_envs.interop.scenes import others, scenario


def test_idm_options_are_the_vehicles_own_and_those_of_vehicles_that_come_later() -> None:
    env = scenario("intersection-v2")
    idm = {"time_headway": 0.7, "jam_distance": 3.0, "max_acceleration": 4.0, "comfortable_deceleration": 2.0}
    env.unwrapped.config["spawn_probability"] = 1.0
    env.reset(seed=0, options=idm)
    env.step(1)
    for vehicle in others(env):
        assert (vehicle.TIME_WANTED, vehicle.DISTANCE_WANTED) == (0.7, 8.0)
        assert (vehicle.COMFORT_ACC_MAX, vehicle.COMFORT_ACC_MIN) == (4.0, -2.0)
    assert (IDMVehicle.TIME_WANTED, IDMVehicle.DISTANCE_WANTED, IDMVehicle.COMFORT_ACC_MIN) == (1.5, 10.0, -5.0)
    assert "TIME_WANTED" not in vars(env.unwrapped.vehicle)
