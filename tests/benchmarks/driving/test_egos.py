"""The record of the egos: what was measured is kept, and the likeliest crash is named."""

from benchmarks.driving import egos
from benchmarks.driving.egos import evaluate_ego, read_results, write_results


def test_an_ego_is_measured_and_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(egos, "EGOS_RESULT", tmp_path / "egos.json")
    assert read_results() == {}
    cell = evaluate_ego("rare_envs/CarFollowing-v0", "idm", "two-stage", 10, tmp_path, at_most=1000)
    assert (cell.words.partition(",")[0], cell.steps) == ("rear_end", 0)
    assert 0 < cell.low < cell.p < cell.high and cell.n_sim <= 1000
    write_results({(cell.env_id, cell.ego, cell.method): cell})
    assert read_results() == {("rare_envs/CarFollowing-v0", "idm", "two-stage"): cell}
