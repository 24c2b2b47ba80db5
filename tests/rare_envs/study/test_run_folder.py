"""The folder of a finished run: what is read back from it, and its study.json."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import rare_envs
from rare_envs.study import BadInput, Question, prepare, run_folder
from rare_envs.study.writing import finish_study_file


def test_what_is_loaded_is_what_the_files_hold(finished_run: Path) -> None:
    study = rare_envs.load_study(finished_run)
    assert study.about["ego"]["name"] == study.question["ego"] == "idm"
    assert study.about["versions"]["rare-envs"] == rare_envs.__version__
    assert [each["name"] for each in study.about["parameters"]] == ["ego_speed", "lead_speed", "gap"]
    low, high = study.interval
    assert low <= study.p <= high
    assert set(study.column_names) >= {"gap", "f", "failed", "log_weight", "crash", "error", "seconds"}


def test_loading_takes_neither_torch_nor_the_simulation(finished_run: Path) -> None:
    code = (
        "import sys, rare_envs; study = rare_envs.load_study(sys.argv[1]); study.episodes(); study.failures\n"
        "assert 'torch' not in sys.modules and 'matplotlib' not in sys.modules, 'slow to import'"
    )
    subprocess.run([sys.executable, "-c", code, str(finished_run)], check=True)


@pytest.mark.parametrize(
    "text",
    ["", "[1]", '{"p": "low", "interval": [0, 1]}', '{"p": true}', '{"p": 0.1, "interval": [0, Infinity]}'],
)
def test_a_damaged_result_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(BadInput, match="No finished run"):
        rare_envs.load_study(tmp_path)
    (tmp_path / "failures.csv").write_text("f,log_p0\n")
    (tmp_path / "result.json").write_text(text)
    with pytest.raises(BadInput, match=r"result\.json"):
        rare_envs.load_study(tmp_path)


def test_what_is_not_what_the_run_wrote_is_named(finished_run: Path, tmp_path: Path) -> None:
    assert rare_envs.load_study(finished_run).changed_files == []
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    content = bytearray((run / "failures.csv").read_bytes())
    content[-2] ^= 1
    (run / "failures.csv").write_bytes(content)
    (run / "episodes.parquet").unlink()
    (run / "report.html").touch()
    assert rare_envs.load_study(run).changed_files == ["failures.csv", "episodes.parquet"]
    (run / "study.json").unlink()
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
    for name in ("result.json", "failures.csv"):
        (tmp_path / name).write_bytes((finished_run / name).read_bytes())
    (tmp_path / "episodes.parquet").write_bytes(study.episodes_path.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"episodes\.parquet"):
        rare_envs.load_study(tmp_path).episodes()


def test_a_run_that_ends_keeps_what_its_file_held_of_the_beginning(tmp_path: Path) -> None:
    study = prepare(Question(env_id="rare_envs/CarFollowing-v0"))
    (tmp_path / "study.json").write_text(json.dumps({"command": "rare-envs estimate", "finished": None}))
    finish_study_file(tmp_path, study, 2.5)
    found = json.loads((tmp_path / "study.json").read_text())
    assert found["command"] == "rare-envs estimate" and found["seconds"] == 2.5 and found["finished"]
    (tmp_path / "study.json").write_text("{")
    finish_study_file(tmp_path, study, 2.5)
    assert json.loads((tmp_path / "study.json").read_text())["seed"] == 0
