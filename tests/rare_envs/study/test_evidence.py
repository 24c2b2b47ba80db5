"""Evidence of a run: every claim can be judged again from its file, and says so when the file no longer supports it."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import jsonschema
import pytest
from typer.testing import Result

from rare_envs.files import digest_file
from rare_envs.study import Question, prepare, run_into
from rare_envs.study.evidence import CELLS, EVIDENCE, FILES, SCHEMA, find_changed, judge_leaf, write_evidence
from rare_envs.study.run_folder import RESULT, STUDY


def make_run(folder: Path, **settings: object) -> Path:
    asked = {"env_id": "CutIn-v0", "method": "mc", "max_sim": 4_000, "seed": 1, **settings}
    run_into(folder, prepare(Question(**asked)))  # type: ignore[arg-type]
    write_evidence(folder)
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
    return {name: json.loads((folder / EVIDENCE / name).read_text(encoding="utf-8")) for name in FILES}


def test_the_files_have_the_fields_of_the_schema(run: Path) -> None:
    content = read(run)
    jsonschema.validate(content, SCHEMA)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**content, "claims.json": {}}, SCHEMA)


def test_each_leaf_is_judged_again_from_its_file(run: Path) -> None:
    nodes = read(run)["claims.json"]["nodes"]
    leaves = [node for node in nodes if node["kind"] == "solution"]  # type: ignore[attr-defined]
    assert len(leaves) >= 10
    assert all(judge_leaf(run, leaf) == leaf["status"] for leaf in leaves)


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
        ("/sums/difference", {"p": 1e-8}),
        ("/sums/difference", {"rate": {"per_million_km": 0.1}}),
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


@pytest.mark.parametrize("name", ["validation.json", "test_cases/00.xosc"])
@pytest.mark.parametrize("removed", [True, False])
def test_a_changed_file_of_the_evidence_supports_nothing_and_is_named(
    run: Path, tmp_path: Path, cli: Callable[..., Result], name: str, removed: bool
) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    path, claims = copy / EVIDENCE / name, read(run)["claims.json"]["nodes"]
    if removed:
        path.unlink()
    else:
        path.write_text(path.read_text(encoding="utf-8") + " ", encoding="utf-8")
    assert find_changed(copy) == [f"{EVIDENCE}/{name}"]
    used = "test_cases.json" if name.startswith("test_cases/") else name
    for leaf in (each for each in claims if each.get("file") == f"{EVIDENCE}/{used}"):  # type: ignore[attr-defined]
        if path.suffix == ".json" and removed:
            with pytest.raises(FileNotFoundError):
                judge_leaf(copy, leaf)
        else:
            assert judge_leaf(copy, leaf) == "not supported"
    assert cli("report", copy, "--evidence").exit_code == 3
    assert f"no evidence: {EVIDENCE}/{name}." in (copy / EVIDENCE / "evidence.html").read_text(encoding="utf-8")
    assert cli("report", copy, "--evidence").exit_code == 0  # written anew


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
        scenario, road = (run / EVIDENCE / name for name in case["files"])
        assert ET.parse(scenario).getroot().tag == "OpenSCENARIO" and ET.parse(road).getroot().tag == "OpenDRIVE"
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


@pytest.mark.slow
def test_a_report_files_the_evidence_of_each_run_of_a_risk(tmp_path: Path, cli: Callable[..., Result]) -> None:
    folder = tmp_path / "risk"
    cli("risk", "idm", "--max-sim", 500, "--out", folder)
    answer = cli("report", folder, "--evidence", "--json")
    assert answer.exit_code == 0, answer.output
    pages = [Path(path) for path in json.loads(answer.stdout)["evidence"] if path.endswith(".html")]
    assert [page.parent.parent.name for page in pages] == ["cut_in", "hard_brake"]
