"""A journal is taken for the points and the f that it was made for, and for nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import samplers
from samplers.execution.executors.chunks import Chunk
from samplers.execution.executors.problem_work import ProblemWork
from samplers.execution.journal import JournalFile
from samplers.execution.journaled_evaluation import JournaledEvaluation
from samplers.execution.record_file import JournalError
from samplers.problem import FloatArray, TermGradients, Terms
from tests.samplers.execution.test_journal import half_space, run


def test_what_does_not_belong_to_the_journal_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "j"
    run(path)
    content = path.read_bytes()
    cases: list[tuple[str, dict[str, object]]] = [
        ("begun with seed 4, and this run has 5", {"seed": 5}),
        ("asks for other points", {"method": "ce"}),
        ("it has changed since", {"f": lambda x: half_space(x) + 0.1}),
    ]
    for words, change in cases:
        with pytest.raises(JournalError, match=words):
            run(path, **change)  # type: ignore[arg-type]
    with pytest.raises(JournalError, match="begun with dim 4, and this run has 3"):
        samplers.estimate(samplers.FunctionProblem(half_space, 3), seed=4, journal=path)
    assert path.read_bytes() == content


def test_an_f_that_is_random_can_be_continued(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)

    def noisy(x: FloatArray) -> FloatArray:
        return half_space(x) + 0.3 * rng.standard_normal(len(x))

    first = run(tmp_path / "j", noisy, "mc")
    assert run(tmp_path / "j", noisy, "mc") == first


def test_f_is_compared_from_its_least_value_to_its_largest_within_what_batches_round(tmp_path: Path) -> None:
    request = Chunk("f", (np.arange(100.0)[:, None],))
    journal = JournalFile.create(tmp_path / "j", {})
    whole = samplers.FunctionProblem(lambda x: x[:, 0], 1)
    JournaledEvaluation(ProblemWork(whole, 0.0, "raise"), journal).evaluate(request)
    journal.close()
    for shift, refused in ((0.0, False), (0.09, False), (0.11, True)):  # a thousandth of the largest |f| is 0.099
        asked: list[FloatArray] = []

        def again(points: FloatArray, shift: float = shift, asked: list[FloatArray] = asked) -> FloatArray:
            asked.append(points[:, 0])
            return np.asarray(points[:, 0] + shift * (points[:, 0] == 99.0))

        journal = JournalFile.open(tmp_path / "j")
        evaluation = JournaledEvaluation(ProblemWork(samplers.FunctionProblem(again, 1), 0.0, "raise"), journal)
        if refused:
            with pytest.raises(JournalError, match=r"f is 99\.11 at a point where .* has 99"):
                evaluation.evaluate(request)
        else:
            ((_, (f, _)),) = evaluation.evaluate(request)
            assert np.array_equal(f, request.x[:, 0])
        assert len(asked) == 1 + refused
        assert (asked[0][0], asked[0][-1], len(asked[0])) == (0.0, 99.0, 8)
        journal.close()


class Series:
    """Two half-spaces in 40 dimensions; it counts what it is asked for, and is interrupted at a certain request."""

    dim, gradient_cost, base = 40, 3.0, samplers.StandardNormal(40)
    normals = np.linalg.qr(np.random.default_rng(0).standard_normal((40, 2)))[0].T

    def __init__(self, last=10**6):
        self.requests, self.last = 0, last

    def _count(self):
        self.requests += 1
        if self.requests > self.last:
            raise KeyboardInterrupt

    def evaluate(self, x):
        return self.terms(x).f

    def terms(self, x, gamma=0.0):
        self._count()
        values = 3.5 - x @ self.normals.T
        return Terms(values.min(axis=1), values, np.zeros(values.shape, dtype=int), gamma, ("left", "right"))

    def gradient(self, x, term, ticks, gamma=0.0):
        self._count()
        return TermGradients(-self.normals[term], 2.5 * len(x))


@pytest.mark.parametrize("last", [1, 2, 5, 11])
def test_a_search_by_terms_is_continued_from_its_journal(tmp_path, last):
    """Interrupted at the walks, in a round or at the end; the rest alone is computed, and the result is the same."""
    undisturbed = Series()
    expected = samplers.estimate(undisturbed, seed=1, max_sim=2000)
    assert undisturbed.requests > 11
    with pytest.raises(KeyboardInterrupt):
        samplers.estimate(Series(last), seed=1, max_sim=2000, journal=tmp_path / "journal")
    rest = Series()
    assert samplers.estimate(rest, seed=1, max_sim=2000, journal=tmp_path / "journal") == expected
    assert rest.requests == undisturbed.requests - last + 1  # f is called once more, to see that it is the same


def test_terms_that_have_changed_are_refused(tmp_path):
    class Nearer(Series):
        def terms(self, x, gamma=0.0):
            seen = super().terms(x, gamma)
            return Terms(seen.f - 1.0, seen.values - 1.0, seen.ticks, seen.threshold, seen.names)

    with pytest.raises(KeyboardInterrupt):
        samplers.estimate(Series(5), seed=1, max_sim=2000, journal=tmp_path / "journal")
    with pytest.raises(JournalError, match="it has changed since"):
        samplers.estimate(Nearer(), seed=1, max_sim=2000, journal=tmp_path / "journal")


def test_a_journal_of_other_terms_is_refused(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        samplers.estimate(Series(5), seed=1, max_sim=2000, journal=tmp_path / "journal")
    with pytest.raises(JournalError, match="asks for other points"):
        samplers.estimate(Series(), seed=1, max_sim=3000, journal=tmp_path / "journal")


def test_a_journal_counts_simulations_not_numbers(tmp_path):
    """Base draws are 200 simulations, of which the journal has 1 + 2 * 2 numbers each; 24 gradients of 2.5 are 60."""
    with pytest.raises(KeyboardInterrupt):
        samplers.estimate(Series(2), seed=1, max_sim=2000, journal=tmp_path / "journal")
    journal = JournalFile.open(tmp_path / "journal")
    assert [record.n_sim for record in iter(journal.read_next, None)] == [200, 60]
    assert journal.n == 260
    journal.close()
