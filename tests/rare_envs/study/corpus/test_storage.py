"""A corpus in its folder: what is added, what is refused, and how rows of x are put together."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rare_envs.study.corpus import add_run, read_corpus, read_run
from rare_envs.study.errors import BadInput


@pytest.fixture
def run(finished_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


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
