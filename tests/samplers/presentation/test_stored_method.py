import pytest

import samplers
from samplers.stored import StoredMethod


class Other(samplers.Method):
    name, stops_at_target = "other", False

    def steps(self, inputs, goal, rng):
        f = yield inputs.base.sample(100, rng)
        return samplers.Outcome.of_counts(int((f <= goal.gamma).sum()), 100, goal.confidence, trace=())


def test_a_method_of_another_package_keeps_its_name(tmp_path):
    problem = samplers.FunctionProblem(lambda x: x[:, 0], dim=1)
    result = samplers.estimate(problem, Other(), seed=0)
    result.save(tmp_path / "result")
    found = samplers.Estimate.load(tmp_path / "result")
    assert found.method == StoredMethod("other", False)
    assert str(found) == str(result)
    with pytest.raises(ValueError, match="cannot run"):
        samplers.estimate(problem, found.method)
