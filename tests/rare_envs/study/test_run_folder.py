"""The folder of a finished run: what is read back from it, its study.json, and the table of all simulations."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import rare_envs
import samplers
from rare_envs.study import Question, episodes, prepare, run_folder, run_into
from rare_envs.study.arguments import UnwrittenResults
from rare_envs.study.episodes import EpisodeTable, digest_scenarios, name_columns
from rare_envs.study.evaluate import resume
from samplers.evaluate import Simulated
from samplers.journal import Journal
from tests.rare_envs.study.refusals import FOLLOWING, full_disk


def test_loading_takes_neither_torch_nor_the_simulation(finished_run: Path) -> None:
    code = (
        "import sys, rare_envs; study = rare_envs.load_study(sys.argv[1]); study.episodes(); study.failures\n"
        "assert 'torch' not in sys.modules and 'matplotlib' not in sys.modules, 'slow to import'"
    )
    subprocess.run([sys.executable, "-c", code, str(finished_run)], check=True)


def test_what_is_not_what_the_run_wrote_is_named(finished_run: Path, tmp_path: Path) -> None:
    assert rare_envs.load_study(finished_run).changed_files == []
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    content = bytearray((run / "failures.csv").read_bytes())
    content[-2] ^= 1
    (run / "failures.csv").write_bytes(content)
    (run / "episodes.parquet").unlink()
    (run / "report.html").touch()
    with pytest.warns(UserWarning, match=r"Not what the run in .* wrote, .*: failures\.csv, episodes\.parquet\."):
        study = rare_envs.load_study(run)
    assert study.changed_files == ["failures.csv", "episodes.parquet"]
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    (run / "result.json").write_text(json.dumps({**result, "p": 1e-9}), encoding="utf-8")
    with pytest.warns(UserWarning, match=r"result\.json, failures\.csv, episodes"):
        assert rare_envs.load_study(run).p == 1e-9
    (run / "study.json").unlink()
    with pytest.warns(UserWarning, match=r"Nothing tells whether the files .*: no study\.json with their digests\."):
        assert rare_envs.load_study(run).changed_files == []


def test_a_damaged_table_and_one_that_is_too_large_for_memory_are_refused(
    finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of a few kilobytes can hold billions of rows that are alike."""
    study = rare_envs.load_study(finished_run)
    with pytest.raises(ValueError, match="has no column gab"):
        study.episodes(["gab"])
    monkeypatch.setattr(run_folder, "MAX_TABLE_BYTES", 2000 * 8)
    with pytest.raises(ValueError, match=r"2 columns of episodes\.parquet take .* GiB, more than the .* ask for fewer"):
        study.episodes(["f", "gap"])
    with pytest.raises(ValueError, match="ask for fewer"):
        study.episodes()
    assert study.episodes(["f"]).num_rows == 2000
    for name in ("result.json", "failures.csv", "study.json"):
        (tmp_path / name).write_bytes((finished_run / name).read_bytes())
    (tmp_path / "episodes.parquet").write_bytes(study.episodes_path.read_bytes()[:-40])
    with pytest.warns(UserWarning, match=r"episodes\.parquet"), pytest.raises(ValueError, match=r"episodes\.parquet"):
        rare_envs.load_study(tmp_path).episodes()


def ask(risky: str, method: str, **more: object) -> Question:
    return Question(**{"env_id": FOLLOWING, "base": risky, "method": method, "max_sim": 900, "horizon": 4.0, **more})


@pytest.mark.parametrize(("method", "replicates"), [("mc", 1), ("mc", 2), ("is", 1), ("two-stage", 1)])
def test_p_is_the_sum_of_the_weights_of_the_failures(risky: str, tmp_path: Path, method: str, replicates: int) -> None:
    report = run_into(tmp_path / "run", prepare(ask(risky, method, replicates=replicates)))
    study = rare_envs.load_study(tmp_path / "run")
    table = study.episodes().to_pydict()
    assert study.p == report.estimate.p > 0
    assert len(table["f"]) == study.result["n_sim"]
    weights = [w for w, failed in zip(table["log_weight"], table["failed"], strict=True) if failed and w is not None]
    assert np.exp(weights).sum() == pytest.approx(study.result["p"], rel=1e-12)
    assert table["simulation"] == list(range(len(table["f"])))
    assert len(table["f"]) == sum(level["n_sim"] for level in study.result["trace"])
    assert set(table["run"]) == set(range(replicates))


def test_a_row_has_the_scenario_its_f_and_its_crash_and_row_groups_are_bounded(
    risky: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episodes, "ROWS_AT_ONCE", 128)
    report = run_into(tmp_path / "run", prepare(ask(risky, "mc", max_sim=400)))
    study = rare_envs.load_study(tmp_path / "run")
    table = study.episodes()
    problem = report.study.problem
    x = np.column_stack([table[name].to_numpy() for name in problem.space.names])
    f = table["f"].to_numpy()
    np.testing.assert_array_equal(problem.evaluate(x), f)
    np.testing.assert_array_equal(table["failed"].to_numpy(), f <= 0)
    failing = study.episodes(failed=True)
    assert set(failing["crash"].to_pylist()) == {"rear_end"} and failing.num_rows == report.estimate.failures.total
    assert study.episodes(["crash"], failed=False)["crash"].null_count == 400 - failing.num_rows
    assert (table["seconds"].to_numpy() > 0).all() and table["error"].null_count == 400
    listed = {tuple(row) for row in np.column_stack([study.failures[name] for name in problem.space.names])}
    assert listed <= {tuple(row) for row in x}
    file = pq.ParquetFile(study.episodes_path)
    assert max(file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)) <= 128
    assert file.schema_arrow.metadata[b"rare_envs.format"] == b"1"


def test_a_resumed_run_tells_the_time_before(risky: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(self: object, *_: object) -> None:
        raise KeyboardInterrupt

    append = Journal.append

    def append_late(self: Journal, *record: object) -> None:
        self._opened = time.monotonic() - 3600.0
        append(self, *record)

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeTable, "write", interrupt)
        patch.setattr(Journal, "append", append_late)
        with pytest.raises(KeyboardInterrupt):
            run_into(tmp_path / "cut", prepare(ask(risky, "is")))
    begun = json.loads((tmp_path / "cut" / "study.json").read_text())
    assert begun["finished"] is None and begun["seed"] == 0
    report, cut = resume(tmp_path / "cut"), rare_envs.load_study(tmp_path / "cut")
    assert 3600.0 <= report.earlier_seconds < report.seconds < 3700.0
    assert (cut.episodes()["seconds"].to_numpy() > 0).all()
    assert cut.about["begun"] == begun["begun"] and cut.about["seconds"] == report.seconds and cut.about["finished"]


def test_large_blocks_are_lists_in_single_precision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "ROWS_AT_ONCE", 8)
    space = rare_envs.DrivingProblem("rare_envs/Highway-v0", noise=False).space
    kinds = name_columns(space)
    assert kinds["weights"].list_size == 404 and str(kinds["speed[5]"]) == "double"
    x = space.sample(20, np.random.default_rng(0))
    table = EpisodeTable(tmp_path, space)
    for part in np.split(x, 4):
        table.add(Simulated(part, np.zeros(5), [], np.ones(5)))
    problem = samplers.FunctionProblem(lambda u: np.ones(len(u)), 3)
    table.write(samplers.estimate(problem, "mc", max_sim=20, seed=0), {})
    table.close()
    found = pq.read_table(tmp_path / "episodes.parquet")
    values = found["weights"].combine_chunks().flatten().to_numpy().reshape(-1, 404)
    np.testing.assert_array_equal(values, space.columns(x)["weights"].astype(np.float32))
    rows = [episodes._as_array(found[name].combine_chunks()) for name in kinds]
    assert digest_scenarios(np.hstack(rows)) == digest_scenarios(x)


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
    monkeypatch.setattr(episodes, "_join_batches", full_disk)
    with pytest.raises(UnwrittenResults, match="300 simulations are kept; go on with: rare-envs resume") as stopped:
        run_into(tmp_path / "run", prepare(ask(risky, "mc", max_sim=300)))
    report = stopped.value.report
    assert "episodes.parquet could not be written: No space left on device" in report.notes
    assert sorted(path.name for path in (tmp_path / "run").glob("*episodes*")) == []
    study = rare_envs.load_study(tmp_path / "run")
    assert study.p == report.estimate.p
    with pytest.raises(FileNotFoundError, match=r"no episodes\.parquet"):
        study.episodes()
