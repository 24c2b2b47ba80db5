"""Learned drivers side by side, compiled by numba: features to accelerations and yaw rates."""

import math
from typing import NamedTuple

import numpy as np

from rare_envs.compilation import compiled, compiled_fused, single, whole
from rare_envs.sensors.lidar import BEAMS
from rare_envs.sensors.perception import FEATURES
from rare_envs.simulation.compiled.dense_layer import apply_layer
from rare_envs.simulation.compiled.equations import ONE, clip
from rare_envs.simulation.compiled.highway.avoidance_lanes import AvoidanceNumbers
from rare_envs.simulation.compiled.highway.dense_driver import DenseDriver
from rare_envs.simulation.compiled.highway.lidar_lanes import LOOKING
from rare_envs.simulation.compiled.networks import pad_units, tanh
from rare_envs.simulation.compiled.rollouts import SingleArray
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

_OUTPUTS, _ACTIONS = 4, 2
"""Two means and two log deviations; acceleration and yaw rate."""
_LENGTH, _WIDTH, _HALF, _NOTHING = single(VEHICLE_LENGTH, VEHICLE_WIDTH, 0.5, 0.0)
_ACCELERATION, _YAW_RATE = whole(0, 1)
NO_NOISE = (_NOTHING, _NOTHING)
"""Of the two actions."""
_OWN = FEATURES.index("range_-162")
"""Features before those of the beams."""


class DriverNumbers(NamedTuple):
    """A `DenseDriver`, its layers padded, in single precision."""

    mean: SingleArray
    """Of the features, shape (51,)."""
    deviation: SingleArray
    bound: float
    first: SingleArray
    """Weights of the first layer, shape (outputs, 52)."""
    first_bias: SingleArray
    second: SingleArray
    second_bias: SingleArray
    cap: float
    avoidance: AvoidanceNumbers
    action_mean: SingleArray
    """Shape (2,), likewise below."""
    action_deviation: SingleArray
    low: SingleArray
    high: SingleArray
    lag_1: SingleArray
    lag_2: SingleArray
    fresh: SingleArray

    @classmethod
    def of(cls, driver: DenseDriver) -> "DriverNumbers":
        """Return the numbers of a driver."""
        (first, first_bias), (second, second_bias) = (_pad_layer(*layer) for layer in driver.hidden)
        bound, cap = single(driver.feature_bound, driver.log_deviation_cap)
        pairs = ("action_mean", "action_deviation", "low", "high", "lag_1", "lag_2", "fresh")
        return cls(
            driver.feature_mean,
            driver.feature_deviation,
            bound,
            first,
            first_bias,
            second,
            second_bias,
            cap,
            AvoidanceNumbers.of(driver.avoidance),
            *(np.array(getattr(driver, name), dtype=np.float32) for name in pairs),
        )


def _pad_layer(weight: SingleArray, bias: SingleArray) -> tuple[SingleArray, SingleArray]:
    """Return a layer with zeros up to numbers of units that `apply_layer` takes."""
    outputs, inputs = (pad_units(width) - width for width in weight.shape)
    padded = np.pad(weight, ((0, outputs), (0, inputs)))
    return np.ascontiguousarray(padded, dtype=np.float32), np.pad(bias, (0, outputs)).astype(np.float32)


class DriverBuffers(NamedTuple):
    """Arrays for drivers side by side, written over at every tick."""

    features: SingleArray
    """Normalised, shape (52, drivers)."""
    first: SingleArray
    """Units of the first hidden layer, shape (outputs, drivers)."""
    second: SingleArray
    head: SingleArray
    """Weights of each driver's last layer, shape (4 (units + 1), drivers)."""
    outputs: SingleArray
    """Shape (4, drivers)."""
    actions: SingleArray
    """Accelerations [m/s^2] and yaw rates [rad/s] that are carried out, shape (2, drivers)."""

    @classmethod
    def of(cls, driver: DenseDriver, drivers: int) -> "DriverBuffers":
        """Return arrays for so many of a driver, with its own last layer."""
        sizes = (pad_units(len(FEATURES)), *(pad_units(len(bias)) for _, bias in driver.hidden))
        head = np.ascontiguousarray(np.repeat(driver.head[:, None], drivers, axis=1), dtype=np.float32)
        sizes += (_OUTPUTS, _ACTIONS)
        features, first, second, *results = (np.zeros((size, drivers), dtype=np.float32) for size in sizes)
        return cls(features, first, second, head, *results)


@compiled
def normalise_feature(value: float, number: int, driver: DriverNumbers) -> float:
    """Return a feature in units of its spread, clipped: `agents.learned.networks.Policy.normalise`."""
    return clip((value - driver.mean[number]) / driver.deviation[number], -driver.bound, driver.bound)


@compiled
def write_own_features(
    features: SingleArray,
    lane: int,
    heading: float,
    speed: float,
    curvature: float,
    left: float,
    right: float,
    driver: DriverNumbers,
) -> None:
    """Write the features of a vehicle but those of its beams: `rare_envs.sensors.perception.perceive`."""
    own = ((left - right) * _HALF, heading, speed, _LENGTH, _WIDTH, curvature, left, right)
    for number in range(len(own)):
        features[number, lane] = normalise_feature(own[number], number, driver)
    for number in range(len(own), _OWN):
        features[number, lane] = normalise_feature(_NOTHING, number, driver)


@compiled_fused
def write_beam_features(features: SingleArray, beams: SingleArray, driver: DriverNumbers) -> None:
    """Write ranges and their rates of all observers, normalised; arguments as of `measure_beams`."""
    drivers = features.shape[1]
    for number in range(2 * BEAMS):
        place = _OWN + number
        row, mean, deviation = features[place], driver.mean[place], driver.deviation[place]
        field = beams[number % BEAMS, LOOKING * (number // BEAMS) :]
        for i in range(drivers):
            row[i] = clip((field[i] - mean) / deviation, -driver.bound, driver.bound)


@compiled
def apply_drivers(driver: DriverNumbers, buffers: DriverBuffers) -> None:
    """Write the outputs of all drivers for their features."""
    drivers = buffers.features.shape[1]
    apply_layer(driver.first, driver.first_bias, buffers.features, buffers.first)
    tanh(buffers.first.reshape(buffers.first.size))
    apply_layer(driver.second, driver.second_bias, buffers.first, buffers.second)
    tanh(buffers.second.reshape(buffers.second.size))
    units = len(buffers.head) // _OUTPUTS - 1
    for output in range(_OUTPUTS):
        apply_own_weights(buffers.head[output * (units + 1) : (output + 1) * (units + 1)], buffers, output, drivers)


@compiled_fused
def apply_own_weights(weights: SingleArray, buffers: DriverBuffers, output: int, drivers: int) -> None:
    """Write one output of all drivers, each of which has weights of its own, shape (units + 1, drivers)."""
    total, units = buffers.outputs[output], len(weights) - 1
    for i in range(drivers):
        total[i] = weights[units, i]
    for unit in range(units):
        weight, value = weights[unit], buffers.second[unit]
        for i in range(drivers):
            total[i] += weight[i] * value[i]


@compiled
def decide_action(
    outputs: SingleArray, lane: int, noise: tuple[float, float], driver: DriverNumbers
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and yaw rate [rad/s]: `agents.learned.driver.LearnedDriver.act`.

    Args:
        outputs: Of all drivers, shape (4, drivers).
        lane: The driver's.
        noise: Of the two actions, in units of their deviations.
        driver: The driver.
    """
    return (
        _limited_action(outputs[0, lane], outputs[2, lane], noise[0], _ACCELERATION, driver),
        _limited_action(outputs[1, lane], outputs[3, lane], noise[1], _YAW_RATE, driver),
    )


@compiled
def _limited_action(mean: float, log_deviation: float, noise: float, action: int, driver: DriverNumbers) -> float:
    """Return one action; exp(cap - softplus(cap - s)) is exp(cap) / (1 + exp(cap - s))."""
    normal = mean
    if noise != _NOTHING:
        normal += math.exp(driver.cap) / (ONE + math.exp(driver.cap - log_deviation)) * noise
    value = driver.action_mean[action] + driver.action_deviation[action] * normal
    return clip(value, driver.low[action], driver.high[action])


@compiled
def next_noise(memory: SingleArray, draws: SingleArray, driver: DriverNumbers) -> tuple[float, float]:
    """Return the noise of a vehicle's two actions: `agents.learned.coloured_noise.AutoregressiveNoise.step`.

    Args:
        memory: Of the two actions the values one and two ticks ago, shape (2, 2), written over.
        draws: Standard normal, shape (2,).
        driver: The driver.
    """
    for action in range(2):
        last = memory[action, 0]
        mean = last * driver.lag_1[action] + memory[action, 1] * driver.lag_2[action]
        memory[action, 0], memory[action, 1] = mean + driver.fresh[action] * draws[action], last
    return memory[0, 0], memory[1, 0]
