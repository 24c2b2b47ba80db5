"""What an estimate says and keeps."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot

import samplers
from samplers.limit_states import half_space
from samplers.output import (
    LABEL,
    StoredMethod,
    fold_rows,
    format_alike,
    read_object,
    register_stored,
    unfold_rows,
    write_object,
)
from tests.samplers.fitted_bases import fitted, resampled, run


def estimate_adss(**options):
    return samplers.estimate(half_space().problem, "adss", seed=1, **options)


def test_to_dict_is_plain_json():
    estimate = estimate_adss()
    data = json.loads(estimate.to_json())
    assert data == estimate.to_dict()
    assert (data["p"], data["status"], len(data["trace"])) == (estimate.p, "converged", len(estimate.trace))
    assert data["method"]["name"] == "adss" and data["method"]["settings"]["n"] == 1000
    assert data["failures"]["total"] == estimate.failures.total


@pytest.mark.parametrize(("method", "target"), [("mc", 0.1), ("is", None), ("mc", None)])
def test_a_run_that_stops_on_what_it_sees_has_ends_that_hold_at_every_look(method: str, target: float | None) -> None:
    estimate = samplers.estimate(half_space(2, 2.0).problem, method, seed=0, max_sim=20_000, target_cov=target)
    if (method, target) == ("mc", None):
        assert estimate.sequence is None and "every look" not in estimate.details()
        return
    (low, high), (below, above) = estimate.interval, estimate.sequence
    assert estimate.n_sim < 20_000 and below < low < high < above
    assert f"at every look [{below:.3e}, {above:.3e}], as the run stopped on what it saw" in estimate.details()
    assert " interval {} to {}\n".format(*format_alike(below, above)) in str(estimate)
    assert estimate.to_dict()["sequence"] == [below, above]
    assert (estimate.meets(0.99 * above).decision, estimate.meets(1.01 * above).decision) == ("undecided", "passes")


def test_says_how_large_a_region_may_have_been_missed():
    estimate = estimate_adss()
    assert estimate.base_draws == 1000
    assert (1 - estimate.unseen) ** 1000 == pytest.approx(0.05)
    said = "a failure region that the search missed: below 3.0e-03 (1,000 base draws, 95 % confidence)"
    assert said == estimate.proviso and said in estimate.details()
    assert (1 - estimate_adss(confidence=0.9).unseen) ** 1000 == pytest.approx(0.1)
    assert estimate.to_dict()["unseen"] == estimate.unseen
    assert replace(estimate, base_draws=0).unseen == 1


def test_without_a_failure_it_says_which_bound_has_which_level():
    never = samplers.FunctionProblem(lambda x: np.ones(len(x)), 1)
    estimate = samplers.estimate(never, "mc", seed=1, max_sim=1000)
    data, text = json.loads(estimate.to_json()), estimate.details()
    assert data["cov"] is None and data["gain"] is None  # no infinities
    assert "warning: None of 1,000 simulations failed" in text and "c.o.v. not known" in text and "gain" not in text
    assert (1 - estimate.interval[1]) ** 1000 == pytest.approx(0.025)
    assert (
        estimate.proviso == "a failure region that the search missed: below 3.0e-03 (1,000 base draws, 95 % confidence)"
    )


@pytest.mark.parametrize("gamma", [0.0, -0.123456789])
def test_an_answer_is_at_most_twelve_lines_of_under_a_hundred_columns(gamma):
    estimate = samplers.estimate(half_space(2, 2.0).problem, "mc", gamma=gamma, seed=1, max_sim=2000)
    told = replace(estimate, given="one die is fixed, " * 30, warnings=("it may be wrong, " * 30, "again", "and again"))
    for each in (estimate, told):
        lines = str(each).splitlines()
        assert len(lines) <= 12 and max(map(len, lines)) < 100 and lines == each.to_dict()["text"].splitlines()
        assert unfold_rows(lines)[0][0] == f"P[f <= {gamma:g}]"
    assert "it may be wrong, " in str(told) and "..." in str(told)


def test_details_say_in_words_how_a_run_ended():
    problem = samplers.FunctionProblem(lambda x: 9.0 - x[:, 0], dim=1)
    for status in samplers.methods.Status:
        estimate = replace(samplers.estimate(problem, "mc", seed=0, max_sim=100), status=status, warnings=())
        assert not {"no_hits", "budget", "stalled"} & {*re.findall(r"\w+", estimate.details())}
        assert estimate.to_dict()["status"] == status


def test_says_what_the_problem_holds_fixed():
    problem = samplers.FunctionProblem(lambda u: 2.0 - u[:, 0], 2)
    problem = SimpleNamespace(dim=2, base=problem.base, evaluate=problem.evaluate, given="one die is fixed")
    fixed = samplers.estimate(problem, "mc", seed=1, max_sim=500)
    assert fixed.to_dict()["given"] == "one die is fixed"
    assert "\n  given that one die is fixed; a failure region that the search missed: below " in fixed.details()
    assert "\nGiven        one die is fixed\n" in str(fixed)
    assert samplers.MonteCarlo(n=500).start(problem, seed=1).result().given == "one die is fixed"


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        (samplers.MonteCarlo(n=3000), 3000),
        (samplers.SubsetSimulation(n=500), 500),
        (samplers.AdaptiveSubsetSimulation(n=500), 500),
        (samplers.CrossEntropy(n_iteration=500, n_final=2000), 500 + 200),
        (samplers.ImprovedCrossEntropy(n_round=500, n_final=2000), 500 + 200),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_counts_base_draws_of_search_and_estimate(method, expected):
    assert samplers.estimate(half_space().problem, method, seed=1).base_draws == expected


def test_an_estimate_comes_back_from_its_file(tmp_path):
    found = estimate_adss(replicates=2)
    found.save(tmp_path / "result")
    loaded = samplers.Estimate.load(tmp_path / "result")
    assert loaded == found
    assert loaded.to_json() == found.to_json()
    assert loaded.base is None
    again = samplers.estimate(half_space().problem, loaded.method, seed=loaded.seed, replicates=2)
    assert again == found
    np.testing.assert_array_equal(loaded.curve([0.0, 1.0]).high, found.curve([0.0, 1.0]).high)


def test_the_uncertainty_of_the_base_is_kept_and_computed_anew_with_the_base(tmp_path):
    base = fitted(resampled(200))
    found = run(base, "ce", max_sim=6000)
    assert found.base_uncertainty is not None
    found.save(tmp_path / "result")
    assert str(samplers.Estimate.load(tmp_path / "result")) == str(found)
    with_base = samplers.Estimate.load(tmp_path / "result", base=base)
    assert "base_uncertainty" not in vars(with_base)
    assert with_base.base_uncertainty == found.base_uncertainty


def test_the_most_likely_failures_are_kept_a_thousand_of_them(recorder):
    f = recorder(lambda x: -np.abs(x[:, 0]))
    found = samplers.estimate(samplers.FunctionProblem(f, 1), "mc", seed=1, max_sim=5000).failures
    nearest = np.sort(np.abs(f.points[:, 0]))[:1000]
    np.testing.assert_array_equal(np.abs(found.x[:, 0]), nearest)
    assert (len(found), found.total) == (1000, 5000)
    assert (np.diff(found.log_p0) <= 0).all()
    x, value, log_p0 = found[0]
    assert (x[0], value, log_p0) == (found.x[0, 0], found.f[0], max(failure.log_p0 for failure in found))


matplotlib.use("Agg")
PNG, PDF = b"\x89PNG", b"%PDF"


@pytest.fixture(scope="module")
def result() -> samplers.Estimate:
    problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
    return samplers.estimate(problem, "mc", seed=0, max_sim=2000)


def test_a_path_is_written_and_leaves_no_figure_open(result: samplers.Estimate, tmp_path: Path) -> None:
    pyplot.close("all")
    axes = result.plot(tmp_path / "p.png")
    result.curve([0.0, 1.0]).plot(str(tmp_path / "curve.pdf"))
    assert axes.get_title() == f"P[f ≤ 0] = {result.p:.2e}"
    assert (tmp_path / "p.png").read_bytes().startswith(PNG)
    assert (tmp_path / "curve.pdf").read_bytes().startswith(PDF)
    assert pyplot.get_fignums() == []
    sensitivity = result.sensitivity(["a", "b"])
    sensitivity.plot(tmp_path / "sensitivity.png")
    assert (tmp_path / "sensitivity.png").read_bytes().startswith(PNG)
    for wrong in (3.0, np.zeros(2), b"p.png"):
        with pytest.raises(TypeError, match="Expected axes of matplotlib or the path of an image"):
            result.plot(wrong)  # type: ignore[arg-type]


def test_notebooks_show_the_text_escaped():
    few = samplers.estimate(half_space(2, 4.0).problem, "mc", seed=1, max_sim=100)
    assert few._repr_html_() == f"<pre>{escape(str(few))}</pre>"
    assert "P[f &lt;= 0]" in few._repr_html_()


@dataclass(frozen=True)
class Thing:
    value: object
    parts: tuple[Thing, ...] = ()
    derived: int = field(default=0, init=False)


register_stored(Thing)


VALUES = [None, True, -3, "text", 0.1 + 0.2, math.inf, -math.inf, (1, (2.5, "a")), [1, [2]], {"a": (1,), 2: None}]


@pytest.mark.parametrize("value", [*VALUES, samplers.Status.BUDGET, np.float64(0.1)])
def test_values_come_back_as_they_were(tmp_path, value):
    write_object(tmp_path / "thing", Thing(value, (Thing("inside"), Thing(math.nan))))
    found = read_object(tmp_path / "thing", Thing)
    assert (found.value, found.parts[0]) == (value, Thing("inside"))
    assert type(found.value) in (type(value), float)
    assert math.isnan(found.parts[1].value)


@pytest.mark.parametrize(
    "array",
    [
        *(np.arange(6.0).reshape(2, 3).T, np.broadcast_to(0.25, 4), np.empty((0, 3)), np.array([np.nan, -np.inf])),
        *(np.array([True, False]), np.arange(3), np.array(2.5)),
    ],
    ids=["transposed", "broadcast", "empty", "nan", "bool", "whole", "scalar"],
)
def test_arrays_come_back_with_their_bits(tmp_path, array):
    write_object(tmp_path / "thing", Thing(array))
    found = read_object(tmp_path / "thing", Thing).value
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array)


def test_other_classes_are_refused_when_written_and_a_name_belongs_to_one_class(tmp_path):
    with pytest.raises(TypeError, match="class function cannot be written"):
        write_object(tmp_path / "thing", Thing(lambda: 0))
    with pytest.raises(ValueError, match="Another class named Thing"):
        register_stored(dataclass(type("Thing", (), {})))


@pytest.mark.parametrize(
    "change",
    [
        *(0, 5, 60, -1),  # cut there
        (b"samplers 1", b"samplers 2"),
        (b'\\"object\\"', b'\\"obxect\\"'),
        (b"Thing", b"Thong"),
        (b'\\"value\\"', b'\\"valve\\"'),
        (b'\\"array0\\"', b'\\"array9\\"'),
    ],
)
def test_a_file_that_was_cut_or_changed_is_refused_in_one_line(tmp_path, change):
    path = tmp_path / "thing"
    write_object(path, Thing(np.arange(100.0)))
    content = path.read_bytes()
    damaged = content[:change] if isinstance(change, int) else content.replace(*change)
    assert damaged != content
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match="damaged") as error:
        read_object(path, Thing)
    assert "\n" not in str(error.value)


def test_a_file_of_something_else_is_refused(tmp_path):
    write_object(tmp_path / "thing", Thing(1))
    with pytest.raises(ValueError, match="got Thing"):
        read_object(tmp_path / "thing", samplers.methods.Level)
    with pytest.raises(FileNotFoundError, match="no file"):
        read_object(tmp_path / "nothing", Thing)
    with pytest.raises(OSError, match=r"Cannot write '.*': "):
        write_object(tmp_path, Thing(1))  # a folder


class Other(samplers.methods.Method):
    name, stops_at_target = "other", False

    def steps(self, inputs, goal, rng):
        f = yield inputs.base.sample(100, rng)
        return samplers.methods.Outcome.of_counts(int((f <= goal.gamma).sum()), 100, goal.confidence, trace=())


def test_a_method_of_another_package_keeps_its_name(tmp_path):
    problem = samplers.FunctionProblem(lambda x: x[:, 0], dim=1)
    result = samplers.estimate(problem, Other(), seed=0)
    result.save(tmp_path / "result")
    found = samplers.Estimate.load(tmp_path / "result")
    assert found.method == StoredMethod("other", False)
    assert str(found) == str(result)
    with pytest.raises(ValueError, match="cannot run"):
        samplers.estimate(problem, found.method)


@pytest.mark.parametrize("most", [1, 2, 3])
@pytest.mark.parametrize(
    "text",
    [
        "cut-in: no lower limit, adds up to 4,500 (more simulations or recordings help); the rest: 62 % cut-in base "
        "distribution, 21 % hard brake base distribution (38 + 265 events of 17 scenes, 30 refits), 17 % simulations, "
        "and something else that is long enough for a third line of this text",
        "one clause without an end that goes on and on for more than two lines of an answer, as (the longest ones, in "
        "brackets do; they have 1,000 words), 12,000 m and more behind it, and an end",
    ],
)
def test_a_long_fact_is_cut_behind_a_clause(text: str, most: int) -> None:
    lines = fold_rows([("Limited by", text)], most)
    assert len(lines) <= most and max(map(len, lines)) < 100
    shown = " ".join(line[LABEL:] for line in lines)
    if shown != text:
        kept = shown.removesuffix(" ...")
        assert shown.endswith(" ...") and text.startswith(kept) and kept.count("(") == kept.count(")")
        assert text[len(kept)] in ";," or (text[len(kept)] == " " and not kept[-1].isdigit())
