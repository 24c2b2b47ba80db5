import math

import numpy as np

from samplers.sample import Layer, Sample

F = np.array([3.0, -1.0, 0.5, -2.0])
X = np.array([[1.0, 2.0], [3.0, 4.0]])


def test_equal_draws_weigh_one_over_n_and_stand_alone():
    sample = Sample.of_equal_draws(F, X)
    np.testing.assert_array_equal(sample.weights, [0.25] * 4)
    np.testing.assert_array_equal(sample.units, [0, 1, 2, 3])
    assert sample.n_units == 4
    assert sample.weights[sample.f <= 0].sum() == 0.5
    np.testing.assert_array_equal(sample.x, X)


def test_a_sample_without_layers_is_its_own_layer():
    sample = Sample.of_equal_draws(F, X)
    (layer,) = sample.all_layers
    assert (layer.low, layer.high) == (-math.inf, math.inf)
    for name in ("f", "weights", "units"):
        np.testing.assert_array_equal(getattr(layer, name), getattr(sample, name))


def test_layers_given_are_the_layers():
    first, second = (Layer(f=F, weights=np.full(4, 0.25), units=np.arange(4), low=low) for low in (1.0, -math.inf))
    sample = Sample(f=F, weights=np.full(4, 0.25), units=np.arange(4), n_units=4, x=X, layers=(first, second))
    assert sample.all_layers == (first, second)
