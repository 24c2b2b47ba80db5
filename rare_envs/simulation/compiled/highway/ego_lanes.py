"""Egos among learned drivers, side by side, compiled by numba: the IDM or a learned driver."""

from typing import NamedTuple

import numpy as np

from rare_envs.control.idm import IDM
from rare_envs.simulation.compiled.compilation import compiled
from rare_envs.simulation.compiled.equations import IDMNumbers, idm_acceleration, steer_to_line, steering_for
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers, lane_middle
from rare_envs.simulation.compiled.highway.dense_driver import DenseDriver
from rare_envs.simulation.compiled.highway.driver_lanes import DriverBuffers, DriverNumbers, decide_action
from rare_envs.simulation.compiled.highway.traffic_slots import Slots, TrafficRows

EGOS_AT_ONCE = 32
"""Egos that are computed side by side."""


class EgoNumbers(NamedTuple):
    """An ego, with arrays for those of all slots."""

    learned: bool
    """Whether it is a learned driver, else the IDM."""
    idm: IDMNumbers
    driver: DriverNumbers
    """The learned driver; with the IDM any."""
    buffers: DriverBuffers

    @classmethod
    def of(cls, ego: IDM | DenseDriver, any_driver: DenseDriver) -> "EgoNumbers":
        """Return the numbers of an ego."""
        driver = any_driver if isinstance(ego, IDM) else ego
        idm = ego if isinstance(ego, IDM) else IDM()
        buffers = DriverBuffers.of(driver, EGOS_AT_ONCE)
        return cls(not isinstance(ego, IDM), IDMNumbers.of(idm), DriverNumbers.of(driver), buffers)


@compiled
def decide_ego(
    rows: TrafficRows, slots: Slots, slot: int, ego: EgoNumbers, road: CurvedRoadNumbers
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and steering angle [rad] of the ego of a slot, whose network has been applied."""
    row = slots.row[slot]
    y, heading, speed = rows.y[row, 0], rows.heading[row, 0], rows.speed[row, 0]
    if ego.learned:
        return steer_as_learned(ego, slot, speed, slots.poses.curvature[slot, 0])
    acceleration = idm_acceleration(ego.idm, speed, slots.gap[slot], slots.closing[slot], ego.idm.desired_speed)
    return acceleration, steer_to_line(y - lane_middle(y, road), heading, speed)


@compiled
def steer_as_learned(ego: EgoNumbers, slot: int, speed: float, curvature: float) -> tuple[float, float]:
    """Return acceleration [m/s^2] and steering angle [rad]: `agents.learned.driver.LearnedEgo.act`."""
    still = np.zeros(2, dtype=np.float32)
    acceleration, yaw_rate = decide_action(ego.buffers.outputs, slot, still, ego.driver)
    return acceleration, steering_for(yaw_rate + speed * curvature, speed)
