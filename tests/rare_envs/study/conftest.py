"""Bases under which crashes are common or do not happen, so that a small run shows both."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from typer.testing import CliRunner, Result

from rare_envs.scenarios.registry import find_scenario
from rare_envs.study import Question, plots, prepare, run_into
from rare_envs.study.cli.app import app

EGOS = """
import sys

import numpy as np
from gymnasium.spaces import Box, Discrete

class Ego:
    observation_space = action_space = None

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return self.choose(observation), state

def made(choose):
    def make():
        ego = Ego()
        ego.choose = choose
        return ego
    return make

def still(observation, width=2):
    return np.zeros((len(observation), width), np.float32)

def idle():  # as a policy of HighwayEnv, which has meta-actions
    ego = made(lambda seen: np.ones(len(seen), int))()
    ego.action_space = Discrete(5)
    return ego

def wrong_space():
    ego = coasting()
    ego.observation_space = Box(-1.0, 1.0, (101,))
    return ego

def random_later():  # after two answers that are alike, as the check before a run wants
    calls = []
    def choose(seen):
        calls.append(1)
        share = np.random.default_rng(len(calls) if len(calls) > 4 else 0).random((len(seen), 1))
        return np.hstack((-share, 0.0 * share))
    return made(choose)()

coasting = made(still)
nan_when_close = made(lambda seen: np.where(seen[:, 3:4] < 0.1, np.nan, 0.0) * np.ones(2))
exiting_when_asked = made(lambda seen: sys.exit(7))
exiting_when_close = made(lambda seen: sys.exit(7) if seen[:, 3].min() < 0.1 else still(seen))
raising = made(lambda seen: 1 / 0)
wrong_shape = made(lambda seen: still(seen, 5))
restless = made(lambda seen: np.random.uniform(-1, 1, (len(seen), 2)))
"""


def write_base(path: Path, gap: float) -> Path:
    """A base for car-following at 20 m/s behind 10 m/s with gaps around the one given."""
    parameters = find_scenario("car_following").parameters
    spread = [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 25.0]]
    base = {
        "names": [p.name for p in parameters],
        "low": [p.low for p in parameters],
        "high": [p.high for p in parameters],
        "weights": [1.0],
        "means": [[20.0, 10.0, gap]],
        "covariances": [spread],
    }
    path.write_text(json.dumps(base))
    return path


class QuickCanvas(FigureCanvasAgg):
    """Draws everything small and where it stands: arranging labels takes longer than a small run."""

    def print_png(self, *args: Any, **kwargs: Any) -> None:
        self.figure.set_layout_engine("none")
        self.figure.set_dpi(20)
        super().print_png(*args, **kwargs)


@pytest.fixture
def full_pictures() -> None:
    """Pictures as users have them: for tests that look at them."""


@pytest.fixture(autouse=True)
def quick_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures by `QuickCanvas`, unless a test asks for `full_pictures`."""
    if "full_pictures" not in request.fixturenames:
        monkeypatch.setattr(plots, "FigureCanvasAgg", QuickCanvas)


@pytest.fixture
def risky(tmp_path: Path) -> str:
    """Gaps around 30 m: about one scenario in thirty ends in a collision."""
    return str(write_base(tmp_path / "risky.json", gap=30.0))


@pytest.fixture
def safe(tmp_path: Path) -> str:
    return str(write_base(tmp_path / "safe.json", gap=100.0))


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of 2,000 simulations by plain Monte Carlo with some 30 collisions, to be copied."""
    folder = tmp_path_factory.mktemp("finished")
    base = str(write_base(folder / "risky.json", gap=30.0))
    asked = Question(env_id="rare_envs/CarFollowing-v0", base=base, method="mc", max_sim=2000, horizon=4.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plots, "FigureCanvasAgg", QuickCanvas)
        run_into(folder / "run", prepare(asked))
    return folder / "run"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with egos of the user's own (`egos_here`) and damaged files."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "egos_here.py").write_text(EGOS)
    (tmp_path / "corrupt.zip").write_bytes(b"PK\x03\x04 this was a model once")
    (tmp_path / "broken.json").write_text('{"names": [')
    (tmp_path / "a_file").write_text("mine")
    return tmp_path


@pytest.fixture
def run(finished_run: Path, here: Path) -> Path:
    """A copy of that run in the working directory."""
    shutil.copytree(finished_run, here / "run")
    return Path("run")


@pytest.fixture
def cli() -> Callable[..., Result]:
    """Run the command line in this process."""
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])
