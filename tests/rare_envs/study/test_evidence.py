"""Evidence of a run: every claim can be judged again from its file, and says so when the file no longer supports it."""

import hashlib
import json
import os
import re
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import jsonschema
import pyarrow.compute
import pyarrow.parquet
import pytest
from typer.testing import Result

from rare_envs.files import digest_file
from rare_envs.study import BadInput, Question, claims, prepare, run_into
from rare_envs.study.claims import find_changed, judge_leaf
from rare_envs.study.evidence import CELLS, EVIDENCE, SCHEMA, write_evidence
from rare_envs.study.run_folder import COMPARISON, RESULT, RISK, STUDY


def make_run(folder: Path, **settings: object) -> Path:
    asked = {"env_id": "CutIn-v0", "method": "mc", "max_sim": 4_000, "seed": 1, **settings}
    run_into(folder, prepare(Question(**asked)))  # type: ignore[arg-type]
    write_evidence(folder, trust=bool(settings.get("trust")))
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with failures."""
    return make_run(tmp_path_factory.mktemp("runs") / "cutin")


@pytest.fixture(scope="module")
def sure(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, as if it had ended without a doubt."""
    copy = shutil.copytree(run, tmp_path_factory.mktemp("sure") / "cutin")
    told: dict[str, object] = {"status": "converged", "cov": 0.1, "parts": [], "doubts": [], "warnings": []}
    sign_again(copy, {**told, "base_uncertainty": {"warnings": []}})  # type: ignore[dict-item]
    write_evidence(copy)
    return copy


def read(folder: Path) -> dict[str, dict[str, object]]:
    paths = [path for path in (folder / EVIDENCE).glob("*.json") if path.name != "evidence.schema.json"]
    return {path.name: json.loads(path.read_text(encoding="utf-8")) for path in paths}


def list_leaves(folder: Path) -> list[dict[str, Any]]:
    nodes: Any = read(folder)["claims.json"]["nodes"]
    return [node for node in nodes if node["kind"] == "solution"]


def test_the_files_have_the_fields_of_the_schema_and_no_others(run: Path) -> None:
    content = read(run)
    jsonschema.validate(content, SCHEMA)
    for other in ({}, {**content["claims.json"], "more": 1}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**content, "claims.json": other}, SCHEMA)


def test_each_leaf_is_judged_again_from_its_file(run: Path) -> None:
    leaves = list_leaves(run)
    assert len(leaves) >= 10
    assert all(judge_leaf(run, leaf) == leaf["status"] for leaf in leaves)


def test_the_result_follows_from_the_simulations_and_says_so_where_it_does_not(
    run: Path, tmp_path: Path, cli: Callable[..., Result]
) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    for folder, wanted in ((run, []), (copy, ["p", "interval", "rate.interval_per_million_km"])):
        if folder == copy:  # p and limits that look better, signed again
            sign_again(copy, {"p": 1e-8, "interval": [0.0, 1e-7], "rate": {"interval_per_million_km": [0.0, 1e-2]}})  # type: ignore[dict-item]
            answer = cli("report", copy, "--evidence", "--json")
            assert answer.exit_code == 3
            assert f"{RESULT} (p, interval, rate.interval_per_million_km)" in json.loads(answer.stdout)["changed"]
        found: Any = read(folder)["validation.json"]["computed_again"]
        assert found["differing"] == wanted
        status = {leaf["pointer"]: leaf["status"] for leaf in list_leaves(folder)}
        assert (status["/computed_again/differing"] == "supported") == (not wanted)


def test_the_result_of_a_policy_ego_follows_from_its_simulations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are done again at its end, where they differ by nothing."""
    (tmp_path / "coasting.py").write_text(
        "import numpy as np\ndef make(): return lambda seen: np.zeros((len(seen), 2))"
    )
    monkeypatch.syspath_prepend(tmp_path)
    folder = make_run(tmp_path / "run", ego="coasting:make", max_sim=300, trust=True)
    assert json.loads((folder / RESULT).read_text(encoding="utf-8"))["repeatability"]["largest"] == 0.0
    found: Any = read(folder)["validation.json"]
    assert found["computed_again"]["differing"] == found["changed"] == []


def test_terms_that_are_simulated_again_are_compared_with_the_recorded_f(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", env_id="CarFollowing-v0", method="series", max_sim=600)
    table = pyarrow.parquet.read_table(folder / "episodes.parquet")
    assert read(folder)["validation.json"]["computed_again"]["differing"] == []  # type: ignore[index]
    safe = pyarrow.compute.add(table["f"], 5.0)
    table = table.set_column(table.column_names.index("f"), "f", safe)
    pyarrow.parquet.write_table(table, folder / "episodes.parquet")
    with pytest.warns(UserWarning, match=r"episodes\.parquet"):
        write_evidence(folder)
    assert "repeatability" in read(folder)["validation.json"]["computed_again"]["differing"]  # type: ignore[index]


def test_large_files_are_read_once_and_in_pieces(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy, asked = shutil.copytree(run, tmp_path / "copy"), list[str]()
    digest = claims.digest_file

    def count(path: Path) -> str:
        asked.append(path.name)
        return digest(path)

    monkeypatch.setattr(claims, "digest_file", count)
    write_evidence(copy)
    assert asked.count("episodes.parquet") == 1
    os.truncate(copy / "episodes.parquet", 128 << 20)
    tracemalloc.start()
    assert find_changed(copy) == ["episodes.parquet"]
    assert tracemalloc.get_traced_memory()[1] < 64 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("name", ["../victim", "..", "", ".", "part/../../victim", "/victim", "link"])
def test_names_of_runs_outside_the_folder_of_a_risk_are_refused(run: Path, tmp_path: Path, name: str) -> None:
    victim, folder = shutil.copytree(run, tmp_path / "victim"), tmp_path / "risk"
    folder.mkdir()
    (folder / "link").symlink_to(victim)
    (folder / RISK).write_text(json.dumps({"scenarios": {name: {}}}), encoding="utf-8")
    (victim / EVIDENCE / "claims.json").write_text("mine", encoding="utf-8")
    with pytest.raises(BadInput, match=r"Expected names of folders in .*, got ") as refused:
        write_evidence(folder)
    assert "\n" not in str(refused.value) and (victim / EVIDENCE / "claims.json").read_text("utf-8") == "mine"


def test_a_claim_is_supported_where_all_below_it_is(run: Path) -> None:
    nodes = {node["id"]: node for node in read(run)["claims.json"]["nodes"]}  # type: ignore[attr-defined]
    assert nodes["G1"]["supports"] is None
    for name, node in nodes.items():
        below = {each["status"] for each in nodes.values() if each["supports"] == name and each["status"]}
        if below:
            assert (node["status"] == "supported") == (below == {"supported"})


@pytest.mark.parametrize(
    ("pointer", "change"),
    [
        ("/sources/2/limited", {"base_uncertainty": {"bound": 1.0, "interval": None}}),
        ("/sources/2/limited", {"rate": {"determined": False}}),
        ("/simulations/enough", {"cov": None}),
        ("/simulations/enough", {"status": "budget"}),
        ("/simulations/enough", {"parts": [{"name": "unseen", "resolved": False, "method": "mc"}]}),
        ("/warnings", {"parts": [{"name": "unseen", "resolved": False, "method": "mc"}]}),
        ("/gate/decision", {"gate": {"decision": "fails", "limit": 1.0, "quantity": "p"}}),
    ],
)
def test_a_result_that_says_less_supports_less(
    sure: Path, tmp_path: Path, pointer: str, change: dict[str, dict[str, object]]
) -> None:
    copy = shutil.copytree(sure, tmp_path / "copy")
    sign_again(copy, change)
    before, after = (
        {each["pointer"]: each["status"] for each in read(folder)["claims.json"]["nodes"] if "pointer" in each}  # type: ignore
        for folder in (sure, copy)
        if folder == sure or write_evidence(folder)
    )
    assert before.get(pointer, "supported") == "supported" and after[pointer] != "supported"


def sign_again(folder: Path, change: dict[str, dict[str, object]]) -> None:
    """Edit result.json, and its digest in study.json as a forger would."""
    result, about = (json.loads((folder / name).read_text(encoding="utf-8")) for name in (RESULT, STUDY))
    for name, value in change.items():
        result[name] = {**(result[name] or {}), **value} if isinstance(value, dict) else value
    (folder / RESULT).write_text(json.dumps(result), encoding="utf-8")
    about["results"][RESULT] = digest_file(folder / RESULT)
    (folder / STUDY).write_text(json.dumps(about), encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "removed"), [("validation.json", False), ("validation.json", True), ("test_cases/00.xosc", False)]
)
def test_a_changed_file_of_the_evidence_supports_nothing_and_is_named(
    run: Path, tmp_path: Path, cli: Callable[..., Result], name: str, removed: bool
) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    path, leaves = copy / EVIDENCE / name, list_leaves(run)
    if removed:
        path.unlink()
    else:
        path.write_text(path.read_text(encoding="utf-8") + " ", encoding="utf-8")
    assert find_changed(copy) == [f"{EVIDENCE}/{name}"]
    used = "test_cases.json" if name.startswith("test_cases/") else name
    leaves = [each for each in leaves if each["file"] == f"{EVIDENCE}/{used}" and each["status"] == "supported"]
    assert leaves
    for leaf in leaves:
        if removed:
            with pytest.raises(FileNotFoundError):
                judge_leaf(copy, leaf)
        else:
            assert judge_leaf(copy, leaf) == "not supported"
    assert cli("report", copy, "--evidence").exit_code == 3
    assert f"no evidence: {EVIDENCE}/{name}." in (copy / EVIDENCE / "evidence.html").read_text(encoding="utf-8")
    manifest = copy / EVIDENCE / "manifest.json"
    answer = json.loads(cli("report", copy, "--evidence", "--json").stdout)  # written anew
    assert answer["changed"] == [] and answer["sha256"] == hashlib.sha256(manifest.read_bytes()).hexdigest()
    manifest.write_text('{"sha256": {}}', encoding="utf-8")  # a list that lists nothing guards nothing
    assert {RESULT, f"{EVIDENCE}/{name}"} <= set(find_changed(copy))


def test_no_limit_is_claimed_where_there_is_none(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    assert re.match(r"Upper limit \S+ per million km; no acceptance limit was set", first_claim(run))
    sign_again(copy, {"base_uncertainty": {"bound": 1.0, "interval": None}})
    write_evidence(copy)
    assert first_claim(copy).startswith("No upper limit; ")


def first_claim(folder: Path) -> str:
    return str(read(folder)["claims.json"]["nodes"][0]["text"])  # type: ignore[index]


def test_test_cases_are_the_likeliest_failures_with_a_road_each(run: Path) -> None:
    cases = read(run)["test_cases.json"]["cases"]
    assert [case["failure"] for case in cases][:1] == [0]  # type: ignore[attr-defined]
    for case in cases:  # type: ignore[attr-defined]
        free, road, recorded, same_road = (ET.parse(run / EVIDENCE / name).getroot() for name in case["files"])
        assert free.tag == recorded.tag == "OpenSCENARIO" and road.tag == same_road.tag == "OpenDRIVE"
        driven = [{each.get("entityRef") for each in story.iter("EntityRef")} for story in (free, recorded)]
        assert driven[1] - driven[0] == {"Ego"}  # the system under test drives it, to the end and not to the crash
        ends = [max(float(each.get("time", 0)) for each in story.iter("Vertex")) for story in (free, recorded)]
        assert ends == pytest.approx([10.0, case["actual_result"]["ends_after_s"]])
        speeds = case["initial_conditions"]["speed_m_s"]
        wanted = [case["parameters"][name] for name in ("ego_speed", "cut_in_speed", "lead_speed")]
        assert speeds == pytest.approx(wanted, rel=1e-6) and case["actual_result"]["f"] == -1.0


def test_what_is_covered_is_one_of_24_disturbances(run: Path) -> None:
    found = read(run)["coverage.json"]["iso_34502"]
    assert found["covered"] == ["main roadway, lane keep, cut-in"]  # type: ignore[index]
    assert len(CELLS) == 24 and len(found["not_covered"]) == 23  # type: ignore[index]


def test_both_simulators_agree_and_failures_replay(run: Path) -> None:
    found = read(run)["validation.json"]
    assert found["replays"]["differing"] == 0 < found["replays"]["compared"]  # type: ignore[index]
    assert found["simulators"]["failures_differing"] == 0 < found["simulators"]["failing_in_either"]  # type: ignore[index]
    assert found["simulators"]["largest_difference_of_f"] < 1e-3  # type: ignore[index]


def test_a_run_without_failures_supports_no_claim_about_them(tmp_path: Path) -> None:
    content = read(make_run(tmp_path / "none", env_id="CarFollowing-v0", base="us101", max_sim=500))
    jsonschema.validate(content, SCHEMA)
    texts = {node["text"]: node["status"] for node in content["claims.json"]["nodes"]}  # type: ignore[attr-defined]
    assert content["test_cases.json"]["cases"] == [] and texts["Failures replay"] == "not known"


def test_the_page_says_what_it_is_not(run: Path) -> None:
    page = (run / EVIDENCE / "evidence.html").read_text(encoding="utf-8")
    assert "no conformity assessment" in page and "<svg" in page and "us101" in page


def test_a_comparison_has_no_evidence_of_its_own(tmp_path: Path, cli: Callable[..., Result]) -> None:
    (tmp_path / COMPARISON).write_text("{}", encoding="utf-8")
    answer = cli("report", tmp_path, "--evidence")
    assert answer.exit_code == 2 and "rare-envs risk EGO --out FOLDER" in answer.stderr.replace("\n", " ")


@pytest.mark.slow
def test_a_report_files_the_evidence_of_each_run_of_a_risk_and_of_the_sum(
    tmp_path: Path, cli: Callable[..., Result]
) -> None:
    folder = tmp_path / "risk"
    cli("risk", "idm", "--max-sim", 500, "--max-rate", 1e9, "--out", folder)
    answer = cli("report", folder, "--evidence", "--json")
    assert answer.exit_code == 0, answer.output
    pages = [Path(path) for path in json.loads(answer.stdout)["evidence"] if path.endswith(".html")]
    assert [page.parent.parent.name for page in pages] == ["cut_in", "hard_brake", "risk"]
    content: Any = read(folder)
    jsonschema.validate(content, SCHEMA)
    recorded = json.loads((folder / RISK).read_text(encoding="utf-8"))
    assert content["uncertainty.json"]["interval_per_million_km"] == recorded["interval_per_million_km"]
    assert content["coverage.json"]["iso_34502"]["covered"] == [f"main roadway, lane keep, {each}" for each in ISO]
    leaves = {leaf["pointer"]: leaf for leaf in list_leaves(folder)}
    assert all(judge_leaf(folder, leaf) == leaf["status"] for leaf in leaves.values())
    assert leaves["/computed_again/differing"]["status"] == leaves["/left_out"]["status"] == "supported"
    assert leaves["/nodes/0/status"]["status"] == "not supported"  # so few simulations have warnings
    recorded["interval_per_million_km"][1] = 0.1
    (folder / RISK).write_text(json.dumps(recorded), encoding="utf-8")
    assert find_changed(folder) == [RISK]
    answer = cli("report", folder, "--evidence", "--json")
    assert answer.exit_code == 3
    assert json.loads(answer.stdout)["changed"] == [f"{RISK} (interval_per_million_km)", RISK]
    del recorded["scenarios"]["hard_brake"]  # the run lies there still; then only the other one says it was asked for
    for removed in (False, True):
        (folder / RISK).write_text(json.dumps(recorded), encoding="utf-8")
        if removed:
            shutil.rmtree(folder / "hard_brake")
        assert "left_out" in json.loads(cli("report", folder, "--evidence", "--json").stdout)["changed"][0]
        leaves = {leaf["pointer"]: leaf["status"] for leaf in list_leaves(folder)}
        assert leaves["/left_out"] == "not supported" and "hard_brake" in str(read(folder)["coverage.json"])


ISO = ("cut-in", "deceleration")
