"""The page of the egos: names of files tell versions of a scenario apart; rows, pictures and what is kept."""

import json

import pytest

from benchmarks.driving import egos
from benchmarks.driving.egos import EgoResult, evaluate_ego, format_page, format_row, read_results, write_results
from rare_envs.scenarios.registry import SCENARIOS


def make_cell(env_id="rare_envs/CutIn-v1", ego="idm", method="two-stage", **more):
    return EgoResult(env_id, ego, method, 1e-3, 5e-4, 2e-3, n_sim=6000, seconds=12.3, warnings=("doubt",), **more)


def test_files_of_two_versions_of_a_scenario_have_different_names():
    assert len({egos.version_of(env_id) for env_id in SCENARIOS}) == len(SCENARIOS)


def test_trained_egos_are_kept_by_version_and_steps(tmp_path, monkeypatch):
    made = []

    def train(env_id, algo, steps, seed, out, base):
        made.append((env_id, algo, steps, base))
        out.write_text("")
        return out

    monkeypatch.setattr(egos, "train_ego", train)
    asked = [("ppo", "rare_envs/CutIn-v0", 10), ("ppo", "rare_envs/CutIn-v1", 10), ("ppo", "rare_envs/CutIn-v1", 20)]
    paths = {egos.train_cached(*each, folder=tmp_path) for each in [*asked, *asked]}
    assert len(paths) == len(made) == 3
    egos.train_cached("dqn", "rare_envs/CarFollowing-v0", 10, tmp_path)
    assert made[-1] == ("rare_envs/CarFollowing-v0", "dqn", 10, "us101-gap")


@pytest.mark.parametrize(("method", "file"), [("two-stage", "ego_CarFollowing-v0_idm.png"), ("adss", "")])
def test_the_picture_is_that_of_the_first_method(tmp_path, method, file):
    cell = evaluate_ego("rare_envs/CarFollowing-v0", "idm", method, 10, tmp_path, tmp_path, at_most=1000)
    assert (cell.picture, cell.steps) == (file, 0)
    assert 0 < cell.low < cell.p < cell.high and cell.n_sim <= 1000
    assert [path.name for path in tmp_path.iterdir()] == ([file] if file else [])


def test_page_has_the_steps_of_trained_egos_and_only_scenarios_that_were_measured():
    shown = make_cell(picture="a.png", words="side, 1.0 m/s")
    page = format_page([shown, make_cell(ego="ppo", steps=20_000)])
    assert format_row(shown) == "| `idm` |  | `two-stage` | 1.00e-03 | 5.00e-04 to 2.00e-03 | 6,000 | 12 s | 1 |"
    assert "| `ppo` | 20,000 | `two-stage` |" in page
    assert page.count("![") == page.count("![idm: side, 1.0 m/s](images/a.png)") == 1
    assert "## rare_envs/CutIn-v1, `us101`" in page
    assert "## rare_envs/HardBrake-v0" not in page


def test_the_page_names_what_is_not_measured():
    everything = [make_cell(env_id, ego) for env_id in SCENARIOS for ego in egos.PAGE_EGOS]
    assert egos.list_missing(everything) == "Each ego was measured in each scenario."
    without = [cell for cell in everything if cell.ego != "vision" or cell.env_id.endswith(("CutIn-v0", "Highway-v0"))]
    told = "Not measured: `vision` in `CarFollowing-v0`; `vision` in `CutIn-v1`; `vision` in `HardBrake-v0`."
    assert egos.list_missing(without) == told
    assert told in format_page(without)


def test_results_are_read_as_they_were_written(tmp_path, monkeypatch):
    monkeypatch.setattr(egos, "EGOS_RESULT", tmp_path / "egos.json")
    assert read_results() == {}
    cells = {(cell.env_id, cell.ego, cell.method): cell for cell in (make_cell(), make_cell(method="adss"))}
    write_results(cells)
    assert read_results() == cells
    assert json.loads((tmp_path / "egos.json").read_text())["command"] == "python -m benchmarks.driving.egos"
