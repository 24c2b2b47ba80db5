import numpy as np
import pytest

from samplers.statistics import effective_sample_size, largest_weight_share, normalise_weights


def test_effective_sample_size():
    assert effective_sample_size(np.zeros(10)) == pytest.approx(10)
    assert effective_sample_size(np.log([1.0, 3.0])) == pytest.approx(16 / 10)
    assert effective_sample_size(np.empty(0)) == 0


def test_weights_far_outside_the_range_of_floats():
    log_weights = np.array([-5000.0, -5000.0 + np.log(3)])
    np.testing.assert_allclose(normalise_weights(log_weights), [0.25, 0.75])
    assert effective_sample_size(log_weights) == pytest.approx(1.6)
    assert largest_weight_share(log_weights) == pytest.approx(0.75)
    assert largest_weight_share(np.empty(0)) == 0
