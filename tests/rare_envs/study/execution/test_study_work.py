"""What workers do for a study is what the driver would do itself."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rare_envs.egos.errors import EgoFault
from rare_envs.study.arguments import Question
from rare_envs.study.errors import BadInput
from rare_envs.study.execution.study_work import StudyWork
from rare_envs.study.question import prepare
from samplers.execution.executors.chunks import Chunk
from samplers.execution.executors.packing import unpack_terms
from tests.rare_envs.study.execution.faulty import FAULTY

FOLLOWING = "rare_envs/CarFollowing-v0"


@pytest.fixture
def faulty(here: Path) -> Path:
    (here / "faulty.py").write_text(FAULTY)
    return here


def work_of(ego: Any = "faulty:nan", on_error: str = "bound", given: Any = None) -> StudyWork:
    return StudyWork(prepare(Question(env_id=FOLLOWING, ego=ego, horizon=2.0, on_error=on_error), ego=given))


def scenarios(n: int = 60) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return scenarios in which the gap shrinks; the ego fails where it is 55 m at a tick."""
    return np.stack((np.full(n, 20.0), np.full(n, 15.0), np.linspace(20.0, 90.0, n)), axis=1)


@pytest.mark.parametrize("kind", ["f", "terms"])
def test_sent_it_does_what_it_did(kind: str, faulty: Path) -> None:
    work = work_of()
    chunk = Chunk(kind, (scenarios(8000),))
    numbers, notes = work(chunk)
    again, further = pickle.loads(pickle.dumps(work))(chunk)
    np.testing.assert_array_equal(again, numbers)
    assert {**further, "seconds": 0.0} == {**notes, "seconds": 0.0}
    lost = int(np.isnan(numbers[: len(chunk)]).sum())
    assert len(notes["reasons"]) == lost > 0


def test_only_the_question_is_sent_where_it_names_the_ego(faulty: Path) -> None:
    assert len(pickle.dumps(work_of())) < 2000
    assert work_of().__getstate__()["problem"] is None
    given = work_of("idm", given="idm")
    assert given.__getstate__()["problem"] is given.problem


def test_another_file_at_the_worker_is_refused(faulty: Path) -> None:
    packed = pickle.dumps(work_of())
    (faulty / "faulty.py").write_text(FAULTY + "\n# changed\n")
    with pytest.raises(BadInput, match=r"faulty\.py is not here, or not the file"):
        pickle.loads(packed)


def test_a_row_that_no_worker_survives_is_a_fault(faulty: Path) -> None:
    row = Chunk("f", (scenarios(1),))
    f, notes = work_of().lose(row, "ended by SIGSEGV")
    assert np.isnan(f).all()
    assert notes["reasons"] == ["ended by SIGSEGV"]
    numbers, notes = work_of().lose(Chunk("terms", row.arrays), "ended")
    assert np.isnan(unpack_terms(numbers, notes, 1).f).all()
    with pytest.raises(EgoFault, match=r"failed on x = \[20\., 15\., 20\.\], whichever worker drove it: ended"):
        work_of(on_error="raise").lose(row, "ended")


def test_chunks_are_known_by_single_precision(faulty: Path) -> None:
    work, x = work_of(), scenarios()
    assert work.digest(Chunk("f", (x,))) == work.digest(Chunk("f", (x + 1e-12,)))
    assert work.digest(Chunk("f", (x,))) != work.digest(Chunk("terms", (x,)))
