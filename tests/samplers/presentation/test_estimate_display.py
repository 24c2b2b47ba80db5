import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space


def run_adss():
    return samplers.estimate(half_space().problem, "adss", seed=1)


def test_the_table_for_notebooks_has_warnings_last():
    few = samplers.estimate(half_space(2, 4.0).problem, "mc", seed=1, max_sim=100)
    text = few._repr_html_()
    assert "95 % interval" in text
    assert text.index("failing points") < text.index("warning: ")


def test_prints_what_a_person_wants_to_know():
    text = str(run_adss())
    for part in ("P[f <= 0] =", "95 % interval", "c.o.v.", "simulations", "gain over Monte Carlo"):
        assert part in text
    assert "warning" not in text


def test_prints_warnings_and_no_gain_without_hits():
    never = samplers.FunctionProblem(lambda x: np.ones(len(x)), 1)
    text = str(samplers.estimate(never, "mc", seed=1, max_sim=100))
    assert "warning: None of 100 simulations failed" in text
    assert "gain" not in text
    assert "c.o.v. not known" in text


def test_remarks_are_printed_and_are_no_warnings():
    few = samplers.estimate(half_space(2, 1.0).problem, "two-stage", seed=1, max_sim=300)
    text = "max_sim leaves 300 simulations, too few for an exploration (400): base draws only."
    assert few.remarks == (text,)
    assert few.warnings == ()
    assert str(few).endswith(f"\n  remark: {text}")
    assert few.to_dict()["remarks"] == [text]


def test_repr_is_one_short_line():
    assert "\n" not in repr(run_adss())
    assert len(repr(run_adss())) <= 160
    assert f"{run_adss().p:.3e}" in repr(run_adss())


def test_the_plot_shows_p_at_gamma():
    pyplot = pytest.importorskip("matplotlib.pyplot")
    figure, axes = pyplot.subplots()
    found = samplers.estimate(half_space(2, 2.0).problem, "mc", seed=0, max_sim=5000)
    found.plot(axes)
    line = next(line for line in axes.lines if len(line.get_xdata()) > 10)
    assert np.interp(0.0, line.get_xdata(), line.get_ydata()) == pytest.approx(found.p)
    pyplot.close(figure)


def test_there_is_nothing_to_plot_where_no_threshold_is_known():
    never = samplers.FunctionProblem(lambda x: np.full(len(x), np.inf), 1)
    with pytest.raises(ValueError, match="nothing to draw"):
        samplers.estimate(never, "mc", seed=1, max_sim=100).plot()
