import json

import numpy as np
import pytest

from benchmarks.estimators.two_stage.ablation import ABLATIONS, AblationRun, compare, main, replace_nested
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS

SET = """
def make():
    return {"half": (lambda u: 3.0 - u[:, 0], 2, 1.3498980316e-3)}
"""


def test_a_row_has_ratios_of_variances_and_of_squared_errors():
    default = [AblationRun(0.1, error, False, False, 100) for error in (0.1, -0.1, 0.2, 0.2)]
    varied = [AblationRun(0.2, 2 * run.error, run.error < 0, False, 200) for run in default]
    row = compare("it", ("a", "b"), varied, default)
    assert row.variance_ratio == pytest.approx(4)
    assert row.error_ratio == pytest.approx(4)
    assert row.error_ratios == pytest.approx({"a": 4, "b": 4})
    assert (row.without, row.coverage, row.low, row.high, row.n_sim) == ("it", 0.75, 1, 0, 200)


@pytest.mark.parametrize("name", ABLATIONS)
def test_every_ablation_changes_settings_that_there_are(name):
    settings = DEFAULT_SETTINGS
    for path, value in ABLATIONS[name].items():
        settings = replace_nested(settings, path, value)
    assert settings != DEFAULT_SETTINGS


def test_without_a_component_p_is_right_all_the_same(tmp_path, capsys):
    path, out = tmp_path / "states.py", tmp_path / "table.json"
    path.write_text(SET)
    main([path], seeds=4, problems="half", only="tempered Gaussians,lines of descent", max_sim=1500, out=out)
    rows = json.loads(out.read_text())["rows"]
    assert [row["without"] for row in rows] == ["nothing", "tempered Gaussians", "lines of descent"]
    assert rows[0]["variance_ratio"] == 1
    assert all(row["coverage"] >= 0.5 for row in rows)  # at 95 % two of four miss once in 600 runs
    assert np.isfinite([row["error_ratio"] for row in rows]).all()
    assert "| lines of descent |" in capsys.readouterr().out
