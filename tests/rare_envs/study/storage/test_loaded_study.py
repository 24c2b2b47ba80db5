from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import rare_envs
from rare_envs.study import BadInput, Question, prepare, run_into
from rare_envs.study import run_folder as loaded_study


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "run"
    run_into(
        path, prepare(Question(env_id="rare_envs/CarFollowing-v0", gamma=3.0, horizon=2.0, method="mc", max_sim=300))
    )
    return path


def test_what_is_loaded_is_what_the_files_hold(folder: Path) -> None:
    study = rare_envs.load_study(folder)
    assert study.about["ego"]["name"] == study.question["ego"] == "idm"
    assert study.about["versions"]["rare-envs"] == rare_envs.__version__
    assert [each["name"] for each in study.about["parameters"]] == ["ego_speed", "lead_speed", "gap"]
    low, high = study.interval
    assert low <= study.p <= high
    assert set(study.column_names) >= {"gap", "f", "failed", "log_weight", "crash", "error", "seconds"}


def test_loading_takes_neither_torch_nor_the_simulation(folder: Path) -> None:
    code = (
        "import sys, rare_envs; study = rare_envs.load_study(sys.argv[1]); study.episodes(); study.failures\n"
        "assert 'torch' not in sys.modules and 'matplotlib' not in sys.modules, 'slow to import'"
    )
    subprocess.run([sys.executable, "-c", code, str(folder)], check=True)


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[1]", '{"p": "low", "interval": [0, 1]}', '{"p": 0.1, "interval": [0]}', '{"p": true}'),
        *('{"p": NaN, "interval": [0, 1]}', '{"p": 0.1, "interval": [-1, 1]}', '{"p": 0.1, "interval": [0, Infinity]}'),
    ],
)
def test_a_damaged_result_is_refused_in_one_line(folder: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "failures.csv").write_text("f,log_p0\n")
    (tmp_path / "result.json").write_text(text)
    with pytest.raises(BadInput, match=r"result\.json"):
        rare_envs.load_study(tmp_path)


def test_what_is_not_what_the_run_wrote_is_named(folder: Path, tmp_path: Path) -> None:
    assert rare_envs.load_study(folder).changed_files == []
    run = Path(shutil.copytree(folder, tmp_path / "run"))
    (run / "result.json").write_text((run / "result.json").read_text().replace('"p": 0.0', '"p": 0.1', 1))
    (run / "episodes.parquet").unlink()
    (run / "report.html").touch()
    assert rare_envs.load_study(run).changed_files == ["result.json", "episodes.parquet"]
    (run / "study.json").unlink()
    assert rare_envs.load_study(run).changed_files == []


def test_a_damaged_table_and_unknown_columns_are_refused(folder: Path, tmp_path: Path) -> None:
    study = rare_envs.load_study(folder)
    with pytest.raises(ValueError, match="has no column gab"):
        study.episodes(["gab"])
    for name in ("result.json", "failures.csv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "episodes.parquet").write_bytes(study.episodes_path.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"episodes\.parquet"):
        rare_envs.load_study(tmp_path).episodes()


def test_a_table_that_is_too_large_for_memory_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of a few kilobytes can hold billions of rows that are alike."""
    study = rare_envs.load_study(folder)
    monkeypatch.setattr(loaded_study, "MAX_TABLE_BYTES", 300 * 8)
    with pytest.raises(ValueError, match=r"2 columns of episodes\.parquet take .* GiB, more than the .* ask for fewer"):
        study.episodes(["f", "gap"])
    with pytest.raises(ValueError, match="ask for fewer"):
        study.episodes()
    assert study.episodes(["f"]).num_rows == 300


def test_a_folder_without_a_finished_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="No finished run"):
        rare_envs.load_study(tmp_path)
