"""Egos in other programs: the short examples pass the check of an ego, and drive alike."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rare_envs
from agents import load_ego
from rare_envs.study.arguments import Question
from rare_envs.study.ego_check import exit_code, run_checks
from rare_envs.study.probe import Finding

pytest.importorskip("zmq", reason="the extra remote is optional")
FOLDER = Path(__file__).parents[2] / "examples" / "remote"
ENV = "rare_envs/CarFollowing-v0"
NODE = shutil.which("node")
PROGRAMS = {"ego.py": [sys.executable], "ego.mjs": [NODE]}


def test_the_examples_are_short_pass_the_check_and_drive_alike() -> None:
    answers = []
    for name, (program,) in PROGRAMS.items():
        assert len((FOLDER / name).read_text().splitlines()) < 40
        if program is None:
            continue
        port = "*" if name == "ego.py" else "0"
        command = [program, str(FOLDER / name), port]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            findings = [each for each in run_checks(Question(env_id=ENV, ego=address)) if isinstance(each, Finding)]
            ego = load_ego(f"{address}?timeout=20&patience=20")
            problem = rare_envs.DrivingProblem(ENV, ego=ego)
            answers.append(problem.evaluate(problem.base.sample(50, np.random.default_rng(0))))
            ego.close()
            process.kill()
        assert exit_code(findings) == 0, [each for each in findings if each.status == "fail"]
        assert sum(each.status == "pass" for each in findings) > 20
    for other in answers[1:]:
        np.testing.assert_allclose(other, answers[0], atol=1e-4)
