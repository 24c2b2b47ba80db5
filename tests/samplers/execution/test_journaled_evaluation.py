"""A journal is taken for the points and the f that it was made for, and for nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import samplers
from samplers.execution.journal import JournalFile
from samplers.execution.journaled_evaluation import JournaledEvaluation
from samplers.execution.record_file import JournalError
from samplers.problem import FloatArray
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
    x = np.arange(100.0)[:, None]
    journal = JournalFile.create(tmp_path / "j", {})
    JournaledEvaluation(journal, lambda x: (x[:, 0], {}), lambda x, known: None, lambda x: x[:, 0]).evaluate(x)
    journal.close()
    for shift, refused in ((0.0, False), (0.09, False), (0.11, True)):  # a thousandth of the largest |f| is 0.099
        asked: list[FloatArray] = []

        def again(points: FloatArray, shift: float = shift, asked: list[FloatArray] = asked) -> FloatArray:
            asked.append(points[:, 0])
            return np.asarray(points[:, 0] + shift * (points[:, 0] == 99.0))

        journal = JournalFile.open(tmp_path / "j")
        evaluation = JournaledEvaluation(journal, lambda x: (x[:, 0], {}), lambda x, known: None, again)
        if refused:
            with pytest.raises(JournalError, match=r"f is 99\.11 at a point where .* has 99"):
                evaluation.evaluate(x)
        else:
            assert np.array_equal(evaluation.evaluate(x), x[:, 0])
        assert len(asked) == 1 + refused
        assert (asked[0][0], asked[0][-1], len(asked[0])) == (0.0, 99.0, 8)
        journal.close()
