"""Workflows: they are valid, and run on the systems and versions that the package supports."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOWS = ROOT / ".github" / "workflows"
NAMES = ("build", "docs", "release", "tests")


def read_workflow(name: str) -> dict[Any, Any]:
    """Return a workflow; YAML reads its key `on` as True."""
    return dict(yaml.safe_load((WORKFLOWS / f"{name}.yml").read_text(encoding="utf-8")))


def test_there_is_a_workflow_for_each_purpose() -> None:
    assert {path.stem for path in WORKFLOWS.glob("*.yml")} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_workflow_is_complete(name: str) -> None:
    workflow = read_workflow(name)
    assert workflow["name"] == name
    assert workflow[True]
    assert workflow["permissions"] == {"contents": "read"}
    for job in workflow["jobs"].values():
        assert "uses" in job or (job["runs-on"] and all("uses" in step or "run" in step for step in job["steps"]))
        needed = job.get("needs", [])
        assert set([needed] if isinstance(needed, str) else needed) <= set(workflow["jobs"])


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for name in NAMES:
        for job in read_workflow(name)["jobs"].values():
            for step in job.get("steps", ()):
                if step.get("run", "").startswith("make "):
                    words = [word for word in step["run"].split()[1:] if re.fullmatch("[a-z-]+", word)]
                    assert words
                    assert set(words) <= targets


ACTIONS = {
    "actions/checkout",
    "actions/download-artifact",
    "actions/setup-python",
    "actions/upload-artifact",
    "pypa/gh-action-pypi-publish",
}
"""Actions that the workflows may use; a new one is looked at before it is named here."""


@pytest.mark.parametrize("name", NAMES)
def test_actions_have_a_version_and_inputs_that_steps_need(name: str) -> None:
    for job in read_workflow(name)["jobs"].values():
        for step in job.get("steps", ()):
            assert ("uses" in step) != ("run" in step)
            if "uses" in step:
                action, _, version = step["uses"].partition("@")
                assert action in ACTIONS
                assert re.fullmatch(r"v\d+|release/v\d+", version)
            for word in re.findall(r"\$\{\{ matrix\.(\w+) \}\}", str(step)):
                assert word in job["strategy"]["matrix"]
        if str(job.get("runs-on")).startswith("${{"):
            assert job["defaults"]["run"]["shell"] == "bash"  # Windows would take another one


def test_an_artifact_that_is_taken_was_left() -> None:
    left, taken = set(), set()
    for name in NAMES:
        for job in read_workflow(name)["jobs"].values():
            for step in job.get("steps", ()):
                if step.get("uses", "").startswith("actions/upload-artifact"):
                    left.add(step["with"]["name"])
                if step.get("uses", "").startswith("actions/download-artifact"):
                    taken.add(step["with"]["name"])
    assert taken == {"packages"}
    assert taken <= left


def test_paths_in_commands_exist() -> None:
    for name in NAMES:
        for job in read_workflow(name)["jobs"].values():
            for step in job.get("steps", ()):
                for path in re.findall(r"(?<![\w./-])(?:tests|rare_envs|samplers)/[\w./]+", step.get("run", "")):
                    if path not in ("rare_envs/CutIn-v0", "rare_envs/CutIn"):
                        assert (ROOT / path).exists(), path


def test_the_wheel_is_installed_on_all_systems_and_versions() -> None:
    matrix = read_workflow("build")["jobs"]["install"]["strategy"]["matrix"]
    assert {system.partition("-")[0] for system in matrix["os"]} == {"ubuntu", "macos", "windows"}
    least = re.search(r'requires-python = ">=3\.(\d+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert least is not None
    assert matrix["python"] == [f"3.{minor}" for minor in range(int(least[1]), 14)]


def test_only_a_tag_is_released_and_only_after_a_build() -> None:
    release = read_workflow("release")
    assert set(release[True]["push"]) == {"tags"}
    assert release["jobs"]["publish"]["needs"] == "build"
    assert release["jobs"]["build"]["needs"] == "version"
    line = (ROOT / "rare_envs" / "version.py").read_text(encoding="utf-8")
    assert re.search(r'^__version__ = "\d+\.\d+\.\d+"$', line, re.MULTILINE)


@pytest.mark.parametrize(
    "path", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda path: path.stem
)
def test_an_issue_form_is_complete(path: Path) -> None:
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= set(form)
    assert all(item["type"] == "textarea" and item["attributes"]["label"] for item in form["body"])
