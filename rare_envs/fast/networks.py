"""Policies of dense layers for rows side by side, compiled by numba: features to accelerations and steering angles.

Every row has the same operations in the same order whatever the others are, so it has the same bits in any block.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.control.actions import DISCRETE_ACTIONS, MAX_ACCELERATION, MAX_STEERING
from rare_envs.egos.dense_policies import DensePolicy
from rare_envs.fast import equations as eq
from rare_envs.fast.equations import compiled, compiled_fused, single
from rare_envs.fast.rows import UNKNOWN, Rows, SingleArray
from rare_envs.simulation.observation import CLIP, EGO_SCALES, OTHER_SCALES, count_features

LANES = 64
"""Rows side by side, a number that the compiler knows."""
AT_ONCE = 4
"""Inputs and outputs of a layer that are computed at once."""
_NOTHING, _BOUND, _ACCELERATION, _STEERING = single(np.nan, CLIP, MAX_ACCELERATION, MAX_STEERING)
_SPEED, _Y, _HEADING = single(*EGO_SCALES.values())
_GAP, _RELATIVE_SPEED, _RELATIVE_Y, _LATERAL_SPEED = single(*OTHER_SCALES.values())
_LEAST_FEATURES = count_features(vehicles=1)
_CHOICES = DISCRETE_ACTIONS.astype(np.float32)
(_LIMIT,) = single(7.905311)
"""Beyond 7.9 the hyperbolic tangent is 1 in single precision."""
_P1, _P3, _P5, _P7, _P9, _P11, _P13 = single(
    4.89352455891786e-03,
    6.37261928875436e-04,
    1.48572235717979e-05,
    5.12229709037114e-08,
    -8.60467152213735e-11,
    2.00018790482477e-13,
    -2.76076847742355e-16,
)
_Q0, _Q2, _Q4, _Q6 = single(4.89352518554385e-03, 2.26843463243900e-03, 1.18534705686654e-04, 1.19825839466702e-06)
_single: Any = np.float32  # to the type checker no float


class PolicyNumbers(NamedTuple):
    """A `DensePolicy` in numbers."""

    weights: SingleArray
    """Of all layers, each of shape (outputs, inputs), flat; inputs are padded with zeros to a multiple of `AT_ONCE`."""
    biases: SingleArray
    """Of all layers, flat."""
    widths: NDArray[np.int64]
    """Units: the padded inputs of the first layer, then the padded outputs of each."""
    bounded: bool
    """Whether the activation is the hyperbolic tangent; else the larger of 0 and the value."""
    chooses: bool
    clip: SingleArray
    """Bounds to which the outputs are clipped, shape (2, 2), the lower ones first."""
    rescales: bool
    rescale: NDArray[np.float64]
    """Bounds that are mapped to [-1, 1], likewise."""
    mean: NDArray[np.float64]
    """Of the observations, shape (F,), likewise the next."""
    deviation: NDArray[np.float64]
    furthest: float
    """Normalised observations are clipped to plus or minus this."""

    @classmethod
    def of(cls, policy: DensePolicy) -> "PolicyNumbers":
        """Return the numbers of a policy."""
        features = policy.layers[0][0].shape[1]
        weights, biases, widths = [], [], [pad(features)]
        for weight, bias in policy.layers:
            padded = np.zeros((pad(len(bias)), widths[-1]), dtype=np.float32)
            padded[: weight.shape[0], : weight.shape[1]] = weight.numpy()
            weights.append(padded.ravel())
            biases.append(np.pad(bias.numpy(), (0, len(padded) - len(bias))))
            widths.append(len(padded))
        anything = [[-np.inf] * 2, [np.inf] * 2]
        mean, deviation, furthest = policy.normalisation or (np.zeros(features), np.ones(features), np.inf)
        return cls(
            weights=np.concatenate(weights),
            biases=np.concatenate(biases),
            widths=np.array(widths),
            bounded=policy.activation == "tanh",
            chooses=policy.chooses,
            clip=np.array(
                anything if policy.clip is None else [bound.numpy() for bound in policy.clip], dtype=np.float32
            ),
            rescales=policy.rescale is not None,
            rescale=np.array(policy.rescale or anything, dtype=np.float64),
            mean=np.asarray(mean, dtype=np.float64),
            deviation=np.asarray(deviation, dtype=np.float64),
            furthest=float(furthest),
        )


def pad(width: int) -> int:
    """Return the next multiple of `AT_ONCE`."""
    return -(-width // AT_ONCE) * AT_ONCE


@compiled
def decide_by_policy(rows: Rows, policy: PolicyNumbers, values: SingleArray, spare: SingleArray) -> None:
    """Decide for at most `LANES` egos, f of failing ones is `UNKNOWN`; writes over two (widest layer, `LANES`)."""
    values[max(4 * len(rows.x) - 1, _LEAST_FEATURES) : policy.widths[0]] = eq.ZERO
    observe(rows, values)
    normalise(policy, values, rows.size)
    apply_layers(policy, values, spare)
    outputs = values if len(policy.widths) % 2 else spare
    for row in range(rows.size):
        acceleration, steering = decode(outputs[:, row], policy)
        known = acceleration == acceleration
        rows.acceleration[row], rows.steering[row] = (acceleration, steering) if known else (eq.ZERO, eq.ZERO)
        rows.f[row] = rows.f[row] if known else UNKNOWN


@compiled
def observe(rows: Rows, values: SingleArray) -> None:
    """Write the features (F, B) of the rows: `rare_envs.simulation.observation.observe_features`."""
    x, y, heading, speed = rows.x[0], rows.y[0], rows.heading[0], rows.speed[0]
    for row in range(rows.size):
        values[0, row], values[1, row] = speed[row] / _SPEED, y[row] / _Y
        values[2, row] = heading[row] / _HEADING
    for other in range(1, len(rows.x)):
        place = 4 * other - 1
        for row in range(rows.size):
            along, other_heading = speed[row] * eq.cosine(heading[row]), rows.heading[other, row]
            other_speed = rows.speed[other, row]
            values[place, row] = (rows.x[other, row] - x[row] - eq.BODY_LENGTH) / _GAP
            values[place + 1, row] = (other_speed * eq.cosine(other_heading) - along) / _RELATIVE_SPEED
            values[place + 2, row] = (rows.y[other, row] - y[row]) / _RELATIVE_Y
            values[place + 3, row] = other_speed * eq.sine(other_heading) / _LATERAL_SPEED
    for feature in range(4 * len(rows.x) - 1):
        for row in range(rows.size):
            values[feature, row] = eq.clip(values[feature, row], -_BOUND, _BOUND)
    for missing in range(4 * len(rows.x) - 1, _LEAST_FEATURES, 4):
        for row in range(rows.size):
            values[missing, row] = _BOUND
            values[missing + 1, row] = values[missing + 2, row] = values[missing + 3, row] = eq.ZERO


@compiled
def normalise(policy: PolicyNumbers, values: SingleArray, size: int) -> None:
    """Normalise features as `VecNormalize` does, in double precision."""
    for feature in range(len(policy.mean)):
        for row in range(size):
            normal = (np.float64(values[feature, row]) - policy.mean[feature]) / policy.deviation[feature]
            values[feature, row] = np.float32(eq.at_most(eq.at_least(normal, -policy.furthest), policy.furthest))


@compiled
def apply_layers(policy: PolicyNumbers, values: SingleArray, spare: SingleArray) -> None:
    """Write the outputs of the network for features, to `values` after an even number of layers, else to `spare`."""
    before, after, last = values, spare, len(policy.widths) - 2
    first_weight, first_bias = 0, 0
    for layer in range(last + 1):
        inputs, outputs = policy.widths[layer], policy.widths[layer + 1]
        weight = policy.weights[first_weight : first_weight + inputs * outputs].reshape((outputs, inputs))
        apply_layer(weight, policy.biases[first_bias : first_bias + outputs], before, after)
        first_weight, first_bias = first_weight + inputs * outputs, first_bias + outputs
        if layer < last:
            activate(after[:outputs].reshape(outputs * LANES), policy.bounded)
        before, after = after, before


@compiled_fused
def apply_layer(weight: SingleArray, bias: SingleArray, before: SingleArray, after: SingleArray) -> None:
    """Write the outputs of a layer, (at least outputs, `LANES`), for inputs likewise."""
    for unit in range(0, len(weight), AT_ONCE):
        sums_0, sums_1, sums_2, sums_3 = after[unit], after[unit + 1], after[unit + 2], after[unit + 3]
        for lane in range(LANES):
            sums_0[lane], sums_1[lane] = bias[unit], bias[unit + 1]
            sums_2[lane], sums_3[lane] = bias[unit + 2], bias[unit + 3]
        for first in range(0, weight.shape[1], AT_ONCE):
            values_0, values_1, values_2, values_3 = (
                before[first],
                before[first + 1],
                before[first + 2],
                before[first + 3],
            )
            w = weight[unit : unit + AT_ONCE, first : first + AT_ONCE]
            a0, a1, a2, a3 = w[0, 0], w[0, 1], w[0, 2], w[0, 3]
            b0, b1, b2, b3 = w[1, 0], w[1, 1], w[1, 2], w[1, 3]
            c0, c1, c2, c3 = w[2, 0], w[2, 1], w[2, 2], w[2, 3]
            d0, d1, d2, d3 = w[3, 0], w[3, 1], w[3, 2], w[3, 3]
            for lane in range(LANES):
                v0, v1, v2, v3 = values_0[lane], values_1[lane], values_2[lane], values_3[lane]
                sums_0[lane] = sums_0[lane] + a0 * v0 + a1 * v1 + a2 * v2 + a3 * v3
                sums_1[lane] = sums_1[lane] + b0 * v0 + b1 * v1 + b2 * v2 + b3 * v3
                sums_2[lane] = sums_2[lane] + c0 * v0 + c1 * v1 + c2 * v2 + c3 * v3
                sums_3[lane] = sums_3[lane] + d0 * v0 + d1 * v1 + d2 * v2 + d3 * v3


@compiled_fused
def activate(values: SingleArray, bounded: bool) -> None:
    """Write hyperbolic tangents of values (n,) over them, to 3e-7 of their size, or the larger of 0 and the value."""
    if not bounded:
        for i in range(len(values)):
            values[i] = eq.ZERO if values[i] < eq.ZERO else values[i]
        return
    for i in range(len(values)):
        x = min(max(values[i], -_LIMIT), _LIMIT) if values[i] == values[i] else values[i]
        s = x * x
        p = s * (s * (s * (s * (s * (s * _P13 + _P11) + _P9) + _P7) + _P5) + _P3) + _P1
        q = s * (s * (s * _Q6 + _Q4) + _Q2) + _Q0
        values[i] = x * p / q


@compiled
def decode(outputs: SingleArray, policy: PolicyNumbers) -> tuple[float, float]:
    """Return acceleration [m/s^2] and steering angle [rad] of a network's outputs; NaN if these are not finite."""
    if policy.chooses:
        best = 0
        for i in range(len(_CHOICES)):
            if not math.isfinite(outputs[i]):
                return _NOTHING, _NOTHING
            if outputs[i] > outputs[best]:
                best = i
        return _CHOICES[best, 0] * _ACCELERATION, _CHOICES[best, 1] * _STEERING
    if not (math.isfinite(outputs[0]) and math.isfinite(outputs[1])):
        return _NOTHING, _NOTHING
    return decode_one(outputs, policy, 0) * _ACCELERATION, decode_one(outputs, policy, 1) * _STEERING


@compiled
def decode_one(outputs: SingleArray, policy: PolicyNumbers, number: int) -> float:
    """Return an output in [-1, 1]: clipped, and rescaled as `rare_envs.egos.wrappers.WrappedPolicy` does."""
    value = eq.clip(outputs[number], policy.clip[0, number], policy.clip[1, number])
    if policy.rescales:
        low, high = policy.rescale[0, number], policy.rescale[1, number]
        value = _single((2.0 * np.float64(value) - low - high) / (high - low))
    return eq.clip(value, -eq.ONE, eq.ONE)
