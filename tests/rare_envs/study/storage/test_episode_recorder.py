from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rare_envs
from rare_envs.study import Question, prepare, run_into
from rare_envs.study.storage.episode_file import EpisodeDraft

FOLLOWING = "rare_envs/CarFollowing-v0"


def ask(risky: str, method: str, **more: object) -> Question:
    return Question(**{"env_id": FOLLOWING, "base": risky, "method": method, "max_sim": 900, "horizon": 4.0, **more})


@pytest.mark.parametrize("on_error", ["failure", "bound"])
def test_faults_have_their_reason_and_count_as_failures(here: Path, risky: str, on_error: str) -> None:
    question = ask(risky, "mc", max_sim=300, ego="egos_here:nan_when_close", on_error=on_error)
    report = run_into(here / "run", prepare(question))
    table = rare_envs.load_study(here / "run").episodes()
    lost = table["f"].is_null().to_numpy()
    assert lost.sum() == len(report.faults) > 0
    reasons = [fault.reason for fault in report.faults]
    assert [text for text in table["error"].to_pylist() if text] == reasons
    assert table["failed"].to_numpy()[lost].all() and table["crash"].filter(lost).null_count == lost.sum()
    assert np.exp(table["log_weight"].to_numpy())[table["failed"].to_numpy()].sum() == pytest.approx(report.estimate.p)


def test_a_table_that_cannot_be_written_does_not_end_the_run(
    risky: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: object, batch: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(EpisodeDraft, "add", refuse)
    report = run_into(tmp_path / "run", prepare(ask(risky, "mc", max_sim=300)))
    assert report.estimate.n_sim == 300
    assert "episodes.parquet could not be written: No space left on device" in report.notes
    assert sorted(path.name for path in (tmp_path / "run").glob("*episodes*")) == []
    study = rare_envs.load_study(tmp_path / "run")
    assert study.p == report.estimate.p
    with pytest.raises(FileNotFoundError, match=r"no episodes\.parquet"):
        study.episodes()
