import json
import math

import numpy as np

import samplers
from samplers.reference import half_space


def result(**options):
    return samplers.estimate(half_space().problem, "adss", seed=1, **options)


def test_prints_what_a_person_wants_to_know():
    text = str(result())
    for part in ("P[f <= 0] =", "95 % interval", "c.o.v.", "simulations", "gain over Monte Carlo"):
        assert part in text
    assert "warning" not in text


def test_prints_warnings_and_no_gain_without_hits():
    never = samplers.FunctionProblem(lambda x: np.ones(len(x)), 1)
    text = str(samplers.estimate(never, "mc", seed=1, max_sim=100))
    assert "warning: None of 100 simulations failed" in text
    assert "gain" not in text
    assert "c.o.v. not known" in text


def test_to_dict_is_plain_json():
    estimate = result()
    data = json.loads(estimate.to_json())
    assert data == estimate.to_dict()
    assert data["p"] == estimate.p
    assert data["status"] == "converged"
    assert data["method"]["name"] == "adss"
    assert data["method"]["settings"]["n"] == 1000
    assert len(data["trace"]) == len(estimate.trace)
    assert data["failures"]["total"] == estimate.failures.total


def test_to_dict_has_no_infinities():
    never = samplers.FunctionProblem(lambda x: np.ones(len(x)), 1)
    data = samplers.estimate(never, "mc", seed=1, max_sim=100).to_dict()
    assert data["cov"] is None
    assert data["gain"] is None
    json.dumps(data, allow_nan=False)


def test_failures_read_as_arrays_and_one_by_one():
    failures = result().failures
    assert failures.x.shape == (len(failures), 2)
    assert (failures.f <= 0).all()
    assert (np.diff(failures.log_p0) <= 0).all()
    x, f, log_p0 = failures[0]
    np.testing.assert_array_equal(x, failures.x[0])
    assert f == failures.f[0]
    assert log_p0 == max(failure.log_p0 for failure in failures)
    assert failures != result(gamma=0.1).failures


def test_failures_kept_do_not_grow_without_end():
    always = samplers.FunctionProblem(lambda x: -np.ones(len(x)), 1)
    failures = samplers.estimate(always, "mc", seed=1, max_sim=5000).failures
    assert len(failures) == 1000
    assert failures.total == 5000


def test_status_prints_as_its_value():
    assert f"{samplers.Status.NO_HITS}" == str(samplers.Status.NO_HITS) == "no_hits"
    assert math.isfinite(result().cov)
