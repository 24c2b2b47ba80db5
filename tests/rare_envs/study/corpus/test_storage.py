"""A corpus in its folder: what is added, what is refused, and how rows of x are put together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rare_envs.study import Question, prepare, run_into
from rare_envs.study.corpus import StoredFailure, add_run, choose_likely, join_x, read_corpus, read_run
from rare_envs.study.errors import BadInput


@pytest.fixture
def run(tmp_path: Path, risky: str) -> Path:
    question = Question(env_id="rare_envs/CarFollowing-v0", base=risky, method="mc", max_sim=2000, horizon=4.0)
    run_into(tmp_path / "run", prepare(question))
    return tmp_path / "run"


def test_failures_of_a_run_are_added_once(run: Path, tmp_path: Path) -> None:
    chosen, new = add_run(run, tmp_path / "corpus", most=5)
    assert new == 5 == len(chosen)
    assert [each.key for each in read_corpus(tmp_path / "corpus")] == sorted(each.key for each in chosen)
    before = {path.name: path.read_bytes() for path in (tmp_path / "corpus").iterdir()}
    assert add_run(run, tmp_path / "corpus", most=5)[1] == 0
    assert {path.name: path.read_bytes() for path in (tmp_path / "corpus").iterdir()} == before
    recorded = read_run(run)
    assert chosen[0] == recorded[0] and recorded[0].log_p0 >= recorded[-1].log_p0
    assert recorded[0].crash == "rear_end" and recorded[0].ego == "idm"


def test_each_kind_of_crash_is_among_the_chosen() -> None:
    kinds = ["rear_end", "rear_end", "side", "rear_end", "rear_ended"]
    failures = [StoredFailure("", {}, {}, -1.0, -float(k), crash=kind) for k, kind in enumerate(kinds)]
    assert [each.log_p0 for each in choose_likely(failures, 3)] == [0.0, -2.0, -4.0]
    assert [each.log_p0 for each in choose_likely(failures, 4)] == [0.0, -1.0, -2.0, -4.0]
    assert [each.log_p0 for each in choose_likely(failures, 4, modes=[3, 0])] == [0.0, -2.0, -3.0, -4.0]
    assert len(choose_likely(failures, 100)) == 5


def test_refusals(run: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="No finished run in"):
        add_run(tmp_path, tmp_path / "corpus")
    with pytest.raises(BadInput, match="at least one"):
        add_run(run, tmp_path / "corpus", most=0)
    assert not (tmp_path / "corpus").exists()
    with pytest.raises(BadInput, match="There is no corpus"):
        read_corpus(tmp_path / "corpus")
    table = (run / "failures.csv").read_text()
    (run / "failures.csv").write_text(table.replace(table.splitlines()[1].split(",")[0], "nan"))
    with pytest.raises(BadInput, match="no number"):
        read_run(run)


def test_rows_of_x() -> None:
    failure = StoredFailure("env", {}, {"gap": [1.0], "noise": [2.0, 3.0], "ego_noise": [4.0]}, -1.0, 0.0)
    assert join_x([failure], ["noise", "gap"], [2, 1]).tolist() == [[2.0, 3.0, 1.0]]
    assert join_x([failure], ["gap", "ego_noise"], [1, 1]).tolist() == [[1.0, 4.0]]
    assert join_x([failure], ["gap", "ego_noise"], [1, 3]).tolist() == [[1.0, 0.0, 0.0, 0.0]]  # another ego's
    for names, sizes in ((["noise"], [3]), (["weights"], [1])):
        with pytest.raises(ValueError, match="have changed since"):
            join_x([failure], names, sizes)
    assert np.isfinite(join_x([failure], ["gap"], [1])).all()
