"""Every kind of file that a command reads, damaged: an answer or one line each, no traceback, and nothing is run.

With `-m slow` 150 of each kind, more than 2,000 in all.
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from typer.testing import CliRunner, Result

import rare_envs
from rare_envs.study import Question, corpus, evaluate, html_report, prepare, writing
from rare_envs.study.cli.app import app
from rare_envs.study.html_report.figures import FigureOfPage
from rare_envs.study.run_folder import JOURNAL
from rare_envs.study.writing import begin_journal
from tests.rare_envs.study.conftest import write_base
from tests.rare_envs.study.refusals import in_file

FOLLOWING = "rare_envs/CarFollowing-v0"
ODD: tuple[Any, ...] = (
    None, True, -1, 10**400, 1e308, "", "x" * 300, "\x00", [], [[[[]]]], {}, {"a": {}}, float("nan"), float("inf"),
)  # fmt: skip
"""Values of which each stands somewhere where another one is expected."""


QUICK, MANY = 4, 150
Damage = Callable[[bytes, np.random.Generator], bytes]
SMALL = ("estimate", FOLLOWING, "--method", "mc", "--max-sim", "20", *in_file(horizon=0.5))
YAML = "env: rare_envs/CarFollowing-v0\nmethod: mc\nmax-sim: 20\nhorizon: 0.5\nseed: 1\ntarget-cov: 0.1\n"
NGSIM = "Vehicle_ID,Frame_ID,Global_Time,Local_X,Local_Y,v_Length,v_Width,v_Class,v_Vel,Lane_ID\n"
MARK = "ran"
"""File that code in a damaged file would write."""


def cli(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


def assert_one_line(result: Result, *accepted: int) -> None:
    """Exit code 2 with one line, or one of those that say that the damage did not matter; never another exception."""
    assert isinstance(result.exception, SystemExit | None), repr(result.exception)
    assert result.exit_code in (2, *accepted), result.output
    assert "Traceback" not in result.stderr
    if result.exit_code == 2:
        lines = [line for line in result.stderr.splitlines() if line.startswith("rare-envs: ")]
        assert len(lines) == 1, result.stderr


def nested(depth: int) -> str:
    return "[" * depth + "]" * depth


def paths_of(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the places of a JSON value, objects and lists first."""
    yield at
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(min(len(value), 2)):
            yield from paths_of(value[key], (*at, key))


def replaced(value: Any, at: tuple[Any, ...], new: Any) -> Any:
    """Return a JSON value with another one in one of its places."""
    if not at:
        return new
    copy = json.loads(json.dumps(value))
    inner = copy
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = new
    return copy


def damage_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut, flip, fill with zeros, double or mix up."""
    kind, at = int(rng.integers(5)), int(rng.integers(max(len(content), 1)))
    flipped = content[:at] + bytes([content[at] ^ int(rng.integers(1, 256))]) + content[at + 1 :]
    zeroed = content[:at] + bytes(min(50, len(content) - at)) + content[at + 50 :]
    return (content[:at], flipped, zeroed, content + content[at:], content[at:] + content[:at])[kind]


def damage_json(text: bytes, rng: np.random.Generator, inside: str | None = None) -> bytes:
    """Replace a value by an odd one, or the text by one that parsers do not like."""
    if rng.random() < 0.2:
        texts = (nested(100_000), '{"a":' * 5000, "1" * 10_000, "\ufeff{}", '{"question": 1e999}', "nan")
        return texts[rng.integers(len(texts))].encode()
    value = json.loads(text)
    places = [at for at in paths_of(value) if inside is None or (at and at[0] == inside)]
    at = places[rng.integers(len(places))]
    return json.dumps(replaced(value, at, ODD[rng.integers(len(ODD))])).encode()


def damage_table(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace a cell, a row or the header of a table."""
    rows = content.decode().splitlines()
    row = int(rng.integers(len(rows)))
    cells = rows[row].split(",")
    odd = ("", "nan", "inf", "1e400", "x", '"', "\x00", "x" * 200_000, "-1e300")
    cells[rng.integers(len(cells))] = odd[rng.integers(len(odd))]
    damaged = [*rows[:row], ",".join(cells if rng.random() < 0.7 else cells[:-1]), *rows[row + 1 :]]
    return "\n".join(damaged if rng.random() < 0.8 else damaged[:1]).encode()


class Kind(NamedTuple):
    """A file and a command that reads it."""

    path: str
    words: tuple[str, ...]
    damage: Damage = damage_bytes
    needs: str = "samplers"
    """What the command needs beside the extra driving."""


def damage_yaml(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace the value of a key by an odd one."""
    odd = ("[[[[", "&a [*a, *a]", "!!python/object/apply:os.system ['touch ran']", "1e999", "null", "{}", "[]", "\x00")
    lines = content.decode().splitlines()
    at = int(rng.integers(len(lines)))
    lines[at] = f"{lines[at].split(':')[0]}: {odd[rng.integers(len(odd))]}"
    return "\n".join(lines).encode()


KINDS = {
    "result read by replay": Kind("run/result.json", ("replay", "run"), damage_json),
    "result read by plan": Kind("run/result.json", ("estimate", "run", "--plan"), damage_json),
    "result read by report": Kind("run/result.json", ("report", "run"), damage_json),
    "study": Kind("run/study.json", ("report", "run"), damage_json),
    "episodes": Kind("run/episodes.parquet", ("report", "run")),
    "failures read by corpus add": Kind("run/failures.csv", ("corpus", "add", "run"), damage_table),
    "failures read by export": Kind(
        "run/failures.csv", ("export", "run", "--out", "crash.xml", "--format", "commonroad"), damage_table
    ),
    "events": Kind("events.csv", ("report", "run", "--events", "events.csv"), damage_table),
    "journal": Kind(f"begun/{JOURNAL}", ("resume", "begun")),
    "stored failure": Kind("corpus/stored.json", ("corpus", "run", "--ego", "idm"), damage_json),
    "question": Kind("study.yaml", ("estimate", "--config", "study.yaml"), damage_yaml),
    "base": Kind("base.json", (*SMALL, "--base", "base.json"), damage_json),
    "policy": Kind("ego.zip", (*SMALL, "--ego", "ego.zip")),
    "statistics": Kind("mine.pkl", (*SMALL[:-2], "--ego", "ego.zip", *in_file(horizon=0.5, stats="mine.pkl"))),
    "network": Kind("ego.onnx", (*SMALL, "--ego", "ego.onnx"), needs="onnxruntime"),
    "drivers": Kind("drivers.safetensors", (*SMALL, "--drivers", "drivers.safetensors")),
    "recording": Kind("tracks.csv", ("fit", "--ngsim", "tracks.csv", "--out", "bases"), damage_table),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a file of every kind."""
    folder = tmp_path_factory.mktemp("good")
    base = str(write_base(folder / "base.json", gap=30.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "save_pictures", lambda path, report: None)
        asked = Question(env_id=FOLLOWING, base="us101-gap", gamma=3.0, horizon=2.0, method="mc", max_sim=600)
        evaluate.run_into(folder / "run", prepare(asked))
    corpus.add_run(folder / "run", folder / "corpus", most=1)
    next(folder.glob("corpus/*.json")).rename(folder / "corpus" / "stored.json")
    write_journal(folder / "begun", base)
    (folder / "study.yaml").write_text(YAML)
    (folder / "events.csv").write_text("gap,ego_speed,lead_speed,site\n20,21,10,a\n60,20,20,b\n40,19,20,b\n")
    tracks = (f"{v},{k},{100 * k},6,{5 * k + 40 * v},15,6,2,50,1\n" for v in (1, 2) for k in range(60))
    (folder / "tracks.csv").write_text(NGSIM + "".join(tracks))
    shutil.copy(Path(rare_envs.__file__).parents[1] / "agents/data/mgail.safetensors", folder / "drivers.safetensors")
    write_policy(folder)
    return folder


def write_journal(folder: Path, base: str) -> None:
    folder.mkdir()
    journal = begin_journal(folder, Question(env_id=FOLLOWING, base=base, horizon=1.0, method="mc", max_sim=60))
    for number in range(3):
        journal.append(f"of other points {number}", np.ones((20, 1)), {"reasons": [], "n_retried": 0}, 20)
    journal.close()


def write_policy(folder: Path) -> None:
    """A policy behind VecNormalize, and the same as ONNX."""
    env = VecNormalize(DummyVecEnv([lambda: gym.make(FOLLOWING, horizon=1.0)]))
    sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu").save(folder / "ego.zip")
    env.save(str(folder / "mine.pkl"))
    if importlib.util.find_spec("onnxruntime"):
        words = ("export", folder / "ego.zip", folder / "ego.onnx", "--stats", folder / "mine.pkl")
        assert cli(*map(str, words)).exit_code == 0


@pytest.fixture
def here(good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it to damage, in the working directory; no pictures are drawn."""
    monkeypatch.setattr(FigureOfPage, "to_svg", lambda _: "")
    monkeypatch.setattr(html_report, "encode_clip", lambda drive: "")
    monkeypatch.setattr(writing, "save_pictures", lambda path, report: None)
    shutil.copytree(good, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("n", [QUICK, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_file_is_read_or_refused_in_one_line(name: str, n: int, here: Path) -> None:
    kind = KINDS[name]
    pytest.importorskip(kind.needs)  # ONNX Runtime is optional
    rng, content = np.random.default_rng(n), (here / kind.path).read_bytes()
    n_refused = 0
    for number in range(n):
        damaged: Any = damage_bytes(content, rng) if number % 3 == 0 else kind.damage(content, rng)
        (here / kind.path).write_bytes(damaged)
        result = cli(*kind.words)
        assert_one_line(result, 0, 3, 4)
        n_refused += result.exit_code == 2
    assert n_refused >= max(1, n // 10)
    assert not (here / MARK).exists()


def npz(**entries: bytes) -> bytes:
    """Return an .npz whose entries are these bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def npy(header: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()


BLOCKS = [
    *(
        npz(gap=npy(header))
        for header in (
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 1000), }",
            "{'descr': '|O', 'fortran_order': False, 'shape': (3, 2), }",
            "{'descr': [('a', '<f4', (10000, 100000))], 'fortran_order': False, 'shape': (3,)}",
            "(" * 3000,
            "__import__('os').system('touch ran')",
        )
    ),
    b"PK\x03\x04 this was an archive once",
    npz(gap=bytes(2000))[:-60],
]


@pytest.fixture
def run(finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it to damage, in the working directory."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def test_damaged_blocks_are_one_line(run: Path) -> None:
    for content in BLOCKS:
        (run / "failures.npz").write_bytes(content)
        assert_one_line(cli("replay", "run"))
    assert not Path("ran").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("name", ["result.json", "failures.npz", JOURNAL])
def test_a_pipe_or_a_device_in_the_place_of_a_file_is_neither_waited_for_nor_read_for_ever(
    name: str, kind: str, run: Path
) -> None:
    (run / name).unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(run / name)
    else:
        (run / name).symlink_to("/dev/zero")
    accepted = (0, 3) if name in ("study.json", "failures.npz") else ()  # others say what is missing, or none is needed
    for words in (("replay",), ("report",), ("corpus", "add"), ("resume",)):
        assert_one_line(cli(*words, "run"), *(accepted if words != ("resume",) else ()))
