"""Egos among learned drivers, side by side, compiled by numba: the IDM, a learned driver or a policy."""

from typing import NamedTuple

import numpy as np

from rare_envs.compilation import compiled, single
from rare_envs.control.idm import IDM
from rare_envs.simulation.compiled.dense_policy import DensePolicy
from rare_envs.simulation.compiled.equations import IDMNumbers, idm_acceleration, steer_to_line, steering_for
from rare_envs.simulation.compiled.highway.avoidance_lanes import limit_action
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers, lane_middle
from rare_envs.simulation.compiled.highway.dense_driver import DenseDriver
from rare_envs.simulation.compiled.highway.driver_lanes import NO_NOISE, DriverBuffers, DriverNumbers, decide_action
from rare_envs.simulation.compiled.highway.driving_rules.close_range import limit_action_near
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import perceive_own
from rare_envs.simulation.compiled.highway.driving_rules.rule_lanes import ease_braking
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import TrafficRules
from rare_envs.simulation.compiled.highway.traffic_slots import NO_ROW, Slots, TrafficRows
from rare_envs.simulation.compiled.networks import LANES, NetworkNumbers, apply_network
from rare_envs.simulation.compiled.policy_rollouts import PolicyNumbers, decode_row, observe_row
from rare_envs.simulation.compiled.rollouts import SingleArray

EGOS_AT_ONCE = 32
"""Egos that are computed side by side."""
BY_RULE, BY_DRIVER, BY_POLICY = range(3)
"""Kinds of egos: the IDM, a `DenseDriver`, a `DensePolicy`."""
(_ZERO,) = single(0.0)
_NO_POLICY = DensePolicy(((np.zeros((4, 4)), np.zeros(4)), (np.zeros((2, 4)), np.zeros(2))), "tanh")


class EgoNumbers(NamedTuple):
    """An ego, with arrays for those of all slots; what is not of its kind is of no meaning."""

    kind: int
    idm: IDMNumbers
    driver: DriverNumbers
    """The learned driver."""
    buffers: DriverBuffers
    """Of the learned driver."""
    policy: PolicyNumbers
    network: NetworkNumbers
    """Of the policy."""
    values: SingleArray
    """Of the network, shape (widest layer, `LANES`)."""
    spare: SingleArray
    actions: SingleArray
    """Acceleration [m/s^2] and steering angle [rad], NaN if unknown, but of the IDM, shape (slots, 2)."""

    @classmethod
    def of(cls, ego: IDM | DenseDriver | DensePolicy, any_driver: DenseDriver) -> "EgoNumbers":
        """Return the numbers of an ego."""
        driver = ego if isinstance(ego, DenseDriver) else any_driver
        policy = ego if isinstance(ego, DensePolicy) else _NO_POLICY
        network = NetworkNumbers.of(policy)
        values, spare = np.zeros((2, network.widths.max(), LANES), dtype=np.float32)
        return cls(
            BY_RULE if isinstance(ego, IDM) else BY_DRIVER if isinstance(ego, DenseDriver) else BY_POLICY,
            IDMNumbers.of(ego if isinstance(ego, IDM) else IDM()),
            DriverNumbers.of(driver),
            DriverBuffers.of(driver, EGOS_AT_ONCE),
            PolicyNumbers.of(policy),
            network,
            values,
            spare,
            np.zeros((EGOS_AT_ONCE, 2), dtype=np.float32),
        )


@compiled
def apply_policies(rows: TrafficRows, slots: Slots, ego: EgoNumbers) -> None:
    """Write the actions of the policies of all slots, by the observation `features`."""
    observed = 4 * rows.x.shape[1] - 1
    ego.values[observed : ego.network.widths[0]] = _ZERO  # the last layers have written there
    for slot in range(len(slots.row)):
        row = slots.row[slot]
        if row != NO_ROW:
            observe_row(rows.x[row], rows.y[row], rows.heading[row], rows.speed[row], ego.policy, ego.values, slot)
    apply_network(ego.network, ego.values, ego.spare)
    for slot in range(len(slots.row)):
        ego.actions[slot, 0], ego.actions[slot, 1] = decode_row(ego.values[:, slot], ego.policy)


@compiled
def steer_as_learned(
    rows: TrafficRows,
    slots: Slots,
    beams: SingleArray,
    ego: EgoNumbers,
    road: CurvedRoadNumbers,
    driving_rules: TrafficRules | None,
) -> None:
    """Write the actions of the learned egos of all slots: `agents.learned.driver.LearnedEgo.act` after its network.

    Args:
        rows: The traffic.
        slots: In which it is driven.
        beams: Of the egos of all slots.
        ego: The ego, whose network has been applied.
        road: The road.
        driving_rules: Of everybody; with None the compiler leaves out what has to do with them.
    """
    for slot in range(len(slots.row)):
        row = slots.row[slot]
        if row == NO_ROW:
            continue
        speed = rows.speed[row, 0]
        acceleration, yaw_rate = decide_action(ego.buffers.outputs, slot, NO_NOISE, ego.driver)
        if driving_rules is None:
            acceleration, yaw_rate = limit_action(acceleration, yaw_rate, speed, beams, slot, ego.driver.avoidance)
        else:
            own = perceive_own(rows.y[row, 0], rows.heading[row, 0], speed, road)
            acceleration = ease_braking(acceleration, driving_rules.ego)
            acceleration, yaw_rate = limit_action_near(acceleration, yaw_rate, own, beams, slot, driving_rules.ego)
        yaw_rate += speed * slots.poses.curvature[slot, 0]
        ego.actions[slot, 0], ego.actions[slot, 1] = acceleration, steering_for(yaw_rate, speed)


@compiled
def decide_ego(
    rows: TrafficRows, slots: Slots, slot: int, ego: EgoNumbers, road: CurvedRoadNumbers
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and steering angle [rad] of the ego of a slot; others than the IDM have decided.

    Args:
        rows: The traffic.
        slots: In which it is driven.
        slot: The ego's.
        ego: The ego.
        road: The road.
    """
    if ego.kind != BY_RULE:
        return ego.actions[slot, 0], ego.actions[slot, 1]
    row = slots.row[slot]
    y, heading, speed = rows.y[row, 0], rows.heading[row, 0], rows.speed[row, 0]
    acceleration = idm_acceleration(ego.idm, speed, slots.gap[slot], slots.closing[slot], ego.idm.desired_speed)
    return acceleration, steer_to_line(y - lane_middle(y, road), heading, speed)
