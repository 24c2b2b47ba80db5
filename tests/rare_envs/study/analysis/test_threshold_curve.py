import numpy as np
import pytest
from scipy import stats

import samplers
from rare_envs.study.report import N_THRESHOLDS, compute_threshold_curve


@pytest.mark.parametrize("method", ["mc", "two-stage", "adss"])
def test_the_curve_starts_at_p_and_its_band_holds_the_truth(method: str) -> None:
    problem = samplers.FunctionProblem(lambda x: 2.5 - x[:, 0], dim=2)
    estimate = samplers.estimate(problem, method, seed=1, max_sim=5000)
    curve = compute_threshold_curve(estimate)
    assert curve is not None and len(curve) == N_THRESHOLDS
    assert curve.gammas[0] == 0.0 and curve.p[0] == pytest.approx(estimate.p)
    truth = stats.norm.cdf(curve.gammas - 2.5)
    assert np.mean((curve.low <= truth) & (truth <= curve.high)) > 0.9
    assert 0.3 < curve.p[-1] < 0.7
