"""What a sensitivity says of itself."""

import json
from dataclasses import replace

import numpy as np
import pytest

import samplers
from tests.samplers.analysis.sensitivity.parametric_normal import BASE, ParametricNormal, fitted, run


@pytest.fixture(scope="module")
def result():
    return run(max_sim=6000)


def test_a_base_without_parameters_has_importance_only():
    problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
    found = samplers.estimate(problem, seed=0, max_sim=3000).sensitivity()
    assert found.parameters == ()
    assert found.columns[0].name == "x1"
    assert str(found).splitlines()[-1] == "the base distribution (StandardNormal) offers no parameters."


def test_json_and_picture(tmp_path):
    found = run(fitted()).sensitivity()
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data["parameters"][0]["share"] == found.parameters[0].share
    assert data["columns"][0]["importance"] == found.columns[0].importance
    from matplotlib.figure import Figure

    figure = Figure()
    left, right = found.plot(list(figure.subplots(1, 2)))
    assert len(left.patches) == 3
    assert len(right.patches) == 6
    figure.savefig(tmp_path / "bars.png")


def test_few_failures_do_not_determine_the_importance():
    """Five draws of 4,000 fail: no importance is above 1, and the table says that it is not determined."""
    problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=3)
    sparse = next(
        result
        for seed in range(50)
        if (result := samplers.estimate(problem, "mc", seed=seed, max_sim=4000)).failures.total == 5
    ).sensitivity()
    assert sparse.points == pytest.approx(5.0)
    assert all(0.0 <= each.importance <= 1.0 for each in sparse.columns)
    assert "from only 5 effective failing points: importance and derivatives are not determined" in str(sparse)
    enough = samplers.estimate(problem, seed=0, max_sim=4000).sensitivity()
    assert "not determined" not in str(enough)


def test_bad_input_is_refused_in_one_line(result):
    safe = samplers.estimate(samplers.FunctionProblem(lambda x: 9.0 - x[:, 0], 2), "mc", max_sim=100)
    with pytest.raises(ValueError, match=r"^No point failed \(f <= 0\): there is nothing to analyse\.$"):
        safe.sensitivity()
    with pytest.raises(ValueError, match="gave no weighted points"):
        replace(result, sample=None).sensitivity()
    with pytest.raises(ValueError, match="does not know its base"):
        replace(result, base=None).sensitivity()
    with pytest.raises(ValueError, match="Expected names and sizes of 3 columns, got 2 names"):
        result.sensitivity(["a", "b"])

    class Broken(ParametricNormal):
        def with_parameters(self, values):
            broken = ParametricNormal(*np.split(np.asarray(values), 2))
            broken.log_prob = lambda x: np.full(len(x), -np.inf)
            return broken

    with pytest.raises(ValueError, match="no finite derivative by the mean of x1 at a failing point"):
        run(Broken(BASE.mean, BASE.sd)).sensitivity()
