"""Rows made anew are what the command prints; all others stay."""

from __future__ import annotations

import copy

import pytest

from benchmarks.papers import renew
from benchmarks.papers.renew import read_records, renew_okelly, renew_tian
from benchmarks.papers.tian2024.replications import ReplicationJob
from tests.benchmarks.papers.same_records import assert_same


def test_without_new_rows_a_record_follows_from_its_own_runs(tmp_path) -> None:
    for paper, record in read_records().items():
        anew = renew_tian(record, tmp_path) if paper == "tian2024" else renew_okelly(record, tmp_path, own=False)
        assert_same(anew, record, paper)
    assert list(tmp_path.iterdir()) == []


def test_a_row_of_tian_that_is_wrong_is_put_right_and_the_others_stay(tmp_path, monkeypatch) -> None:
    """One replication is made and gives what is committed; the others are taken from there."""
    record = read_records()["tian2024"]
    wrong = copy.deepcopy(record)
    (group,) = [
        each
        for each in wrong["runs"]
        if (each["scenario"], each["system"], each["method"]) == ("cut-in", "IDM", "cross-entropy")
    ]
    group["p"][0] *= 2
    made = []

    def make(job):
        made.append(job)
        return known[job.scenario, job.system, job.method, job.seed]

    known = {run.key: run for run in renew.read_replications(record)}
    job = ReplicationJob("cut-in", "IDM", "cross-entropy", group["seed"][0])
    known[job.scenario, job.system, job.method, job.seed] = renew.run_replication(job)
    monkeypatch.setattr(renew, "run_replication", make)
    anew = renew_tian(wrong, tmp_path, ["cross-entropy"])
    assert len(made) == 4 * record["about"]["replications"]
    for one, other in zip(anew["tables"], record["tables"], strict=True):
        for row, shown in zip(one["measured"], other["measured"], strict=True):
            assert row["values"] == pytest.approx(shown["values"], rel=1e-6)
        assert_same(one["values"], other["values"])
    for name in ("figures", "findings", "notes"):
        assert_same(anew[name], record[name], name)
    renew_tian(wrong, tmp_path, ["cross-entropy"])
    assert len(made) == 4 * record["about"]["replications"]  # none is made twice


def test_rows_of_the_papers_methods_take_a_whole_run(tmp_path) -> None:
    with pytest.raises(ValueError, match="Expected methods of ADSS as printed, two-stage"):
        renew_tian(read_records()["tian2024"], tmp_path, ["SS"])


def test_our_rows_of_okelly_are_put_right(tmp_path, monkeypatch) -> None:
    record = read_records()["okelly2018"]
    shown = record["runs"][0]["own"]
    wrong = copy.deepcopy(record)
    for own in wrong["runs"][0]["own"]:
        own.update(p=1.0, gain=1.0)

    def estimate(study, folder, problem, gammas, progress):
        assert gammas == list(study.gammas)
        return [{name: value for name, value in own.items() if name != "gain"} for own in shown]

    monkeypatch.setattr(renew, "estimate_own", estimate)
    assert_same(renew_okelly(wrong, tmp_path), record)
