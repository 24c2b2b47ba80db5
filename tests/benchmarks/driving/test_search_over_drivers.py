"""The study of searches over drivers: its statistics by hand, its methods as the paper has them."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from benchmarks.driving import search_over_drivers as study
from benchmarks.driving.failing_traffic import failing_points, weighted_mean, weighted_variance
from samplers import CrossEntropy


def test_the_paper_s_settings():
    paper = study.SEARCH_METHODS["ce-paper"]
    assert isinstance(paper, CrossEntropy)
    assert (paper.max_iterations, paper.n_iteration, paper.rho, paper.alpha) == (100, 5000, 0.01, 0.8)
    assert (paper.family, paper.likelihood_ratio, paper.choice, paper.early_end) == (
        "blocks",
        "joint",
        "quantile",
        False,
    )
    assert set(study.OWN_BUDGET) | set(study.ONCE) <= set(study.SEARCH_METHODS)


def test_failing_points_of_several_runs_are_weighted_together():
    """Run 1 has two of three points at or under gamma = 1, run 2 its only one, run 3 kept none."""

    def run(x, f, weights):
        return SimpleNamespace(
            gamma=1.0, sample=SimpleNamespace(x=np.array(x), f=np.array(f), weights=np.array(weights))
        )

    one = run([[1.0], [2.0]], [0.5, 1.0, 3.0], [1.0, 2.0, 7.0])
    two = run([[3.0]], [-1.0], [5.0])
    x, weights = failing_points([one, two, SimpleNamespace(gamma=1.0, sample=None)])
    assert x.ravel().tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(weights, [1 / 8, 2 / 8, 5 / 8])


def test_weighted_statistics_by_hand():
    values, weights = np.array([[0.0, 1.0], [2.0, 5.0]]), np.array([0.25, 0.75])
    np.testing.assert_allclose(weighted_variance(values, weights), [0.75, 3.0])
    chosen = np.array([[True, False], [True, True]])
    assert weighted_mean(values, chosen, weights) == pytest.approx((0.75 * 2.0 + 0.75 * 5.0) / 1.75)


def test_pieces_add_up():
    assert list(study.split_sizes(20_000, 8192)) == [8192, 8192, 3616]


@pytest.mark.parametrize(("option", "word"), [("--methods", "cee"), ("--noise", "loud")])
def test_words_are_checked_before_anything_is_simulated(option, word, monkeypatch):
    monkeypatch.setattr(study, "run_reference", lambda *_: pytest.fail("simulated"))
    app = typer.Typer()
    app.command()(study.main)
    result = CliRunner().invoke(app, [option, word])
    assert result.exit_code == 2
    assert word in result.output


def test_a_reference_of_another_question_is_refused(tmp_path):
    question = {"ego": "idm", "gamma": 0.5}
    path = tmp_path / "report.json"
    path.write_text(json.dumps({"question": question, "reference": {"p": 1e-3}}))
    assert study.read_reference(path, question) == {"p": 1e-3}
    with pytest.raises(typer.BadParameter, match=r"'gamma': 0\.5"):
        study.read_reference(path, {**question, "gamma": 0.4})
