"""Dense networks for a block of rows, compiled by numba.

`LANES` rows go through a layer side by side, so that the compiler vectorises over them. Every row has the same
operations in the same order whatever the others are, so its outputs are the same bits in any block.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.compilation import compiled, compiled_fused, single
from rare_envs.simulation.compiled.dense_layer import UNITS_AT_ONCE, apply_layer
from rare_envs.simulation.compiled.dense_policy import DensePolicy
from rare_envs.simulation.compiled.rollouts import SingleArray

LANES = 64
"""Rows side by side, a number that the compiler knows, a multiple of `dense_layer.STRIP`."""
_ZERO, _LIMIT = single(0.0, 7.905311)
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


class NetworkNumbers(NamedTuple):
    """The layers of a `DensePolicy`, padded and one behind the other, in single precision."""

    weights: SingleArray
    """Of all layers, each of shape (outputs, inputs), flat."""
    biases: SingleArray
    """Of all layers, flat."""
    widths: NDArray[np.int64]
    """Units: the padded inputs of the first layer, then the padded outputs of each."""
    bounded: bool
    """Whether the activation is the hyperbolic tangent; else the larger of 0 and the value."""

    @classmethod
    def of(cls, policy: DensePolicy) -> "NetworkNumbers":
        """Return the layers of a policy."""
        weights, biases, widths = [], [], [pad_units(policy.layers[0][0].shape[1])]
        for weight, bias in policy.layers:
            padded = np.zeros((pad_units(len(bias)), widths[-1]), dtype=np.float32)
            padded[: weight.shape[0], : weight.shape[1]] = weight
            weights.append(padded.ravel())
            biases.append(np.pad(bias.astype(np.float32), (0, len(padded) - len(bias))))
            widths.append(len(padded))
        return cls(np.concatenate(weights), np.concatenate(biases), np.array(widths), policy.activation == "tanh")


def pad_units(width: int) -> int:
    """Return the next multiple of `UNITS_AT_ONCE`."""
    return -(-width // UNITS_AT_ONCE) * UNITS_AT_ONCE


@compiled_fused
def tanh(values: SingleArray) -> None:
    """Write the hyperbolic tangents of values (n,) over them, to 3e-7 of their size.

    The rational function of Eigen (`generic_fast_tanh_float`, Mozilla Public License 2.0), which is vectorised.
    """
    for i in range(len(values)):
        x = min(max(values[i], -_LIMIT), _LIMIT) if values[i] == values[i] else values[i]
        s = x * x
        p = s * (s * (s * (s * (s * (s * _P13 + _P11) + _P9) + _P7) + _P5) + _P3) + _P1
        q = s * (s * (s * _Q6 + _Q4) + _Q2) + _Q0
        values[i] = x * p / q


@compiled
def relu(values: SingleArray) -> None:
    """Write the larger of 0 and the value over values (n,); NaN stays."""
    for i in range(len(values)):
        values[i] = _ZERO if values[i] < _ZERO else values[i]


@compiled
def apply_network(network: NetworkNumbers, values: SingleArray, spare: SingleArray) -> None:
    """Write the outputs of a block over its observations.

    Args:
        network: The network.
        values: Observations in the first rows, zeros in those that pad them, shape (widest layer, `LANES`); the
            outputs are written to the first rows, and the others written over.
        spare: Of the same shape; written over.
    """
    before, after, last = values, spare, len(network.widths) - 2
    weight_start, bias_start = 0, 0
    for layer in range(last + 1):
        inputs, outputs = network.widths[layer], network.widths[layer + 1]
        weight = network.weights[weight_start : weight_start + inputs * outputs].reshape((outputs, inputs))
        apply_layer(weight, network.biases[bias_start : bias_start + outputs], before, after)
        weight_start, bias_start = weight_start + inputs * outputs, bias_start + outputs
        if layer < last and network.bounded:
            tanh(after[:outputs].reshape(outputs * LANES))
        elif layer < last:
            relu(after[:outputs].reshape(outputs * LANES))
        before, after = after, before
    if last % 2 == 0:  # an odd number of layers ends in the spare array
        for output in range(network.widths[-1]):
            for lane in range(LANES):
                values[output, lane] = spare[output, lane]
