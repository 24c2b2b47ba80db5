"""Files that are damaged, by chance or on purpose, are one line, and never a traceback."""

from __future__ import annotations

import io
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from rare_envs.study import evaluate, writing
from rare_envs.study.arguments import Question, read_question
from rare_envs.study.cli.app import app
from rare_envs.study.errors import BadInput
from rare_envs.study.journal import JOURNAL, begin_journal
from rare_envs.study.question import prepare
from samplers.execution.journal import JournalRecord

FOLLOWING = "rare_envs/CarFollowing-v0"
ODD: tuple[Any, ...] = (
    None, True, -1, 10**400, 1e308, "", "x" * 300, "\x00", [], [[[[]]]], {}, {"a": {}}, float("nan"), float("inf"),
)  # fmt: skip
"""Values of which each stands somewhere where another one is expected."""


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


def npz(**entries: bytes) -> bytes:
    """Return an .npz whose entries are these bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def npy(header: str, content: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    return (
        b"\x93NUMPY"
        + version
        + len(header).to_bytes(2 if version == b"\x01\x00" else 4, "little")
        + header.encode()
        + content
    )


HEADERS = (
    "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 1000), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (3, 2), }",
    "{'descr': '<U9', 'fortran_order': False, 'shape': (3, 2), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (3, -2), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': 'x', }",
    "{'descr': '<f4', 'fortran_order': False}",
    "{'descr': [('a', '<f4', (10000, 100000))], 'fortran_order': False, 'shape': (3,)}",
    "(" * 3000,
    "__import__('os').system('touch ran')",
    "{'descr': '<c8', 'fortran_order': False, 'shape': (0, 2), }",
    "",
)
BLOCKS = [
    *(npz(gap=npy(header)) for header in HEADERS),
    npz(gap=npy(HEADERS[0], version=b"\x02\x00")),
    npz(gap=b"\x93NUMPY\x09\x00"),
    npz(gap=b"not an array"),
    npz(),
    b"PK\x03\x04 this was an archive once",
    b"",
    npz(gap=bytes(2000))[:-60],
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with a few failures."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "save_plot", lambda path, report: None)
        evaluate.run_into(
            folder / "run",
            prepare(Question(env_id=FOLLOWING, base="us101-gap", gamma=3.0, horizon=2.0, method="mc", max_sim=600)),
        )
    return folder / "run"


@pytest.fixture
def run(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it to damage, in the working directory."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(finished, tmp_path / "run"))


def cli(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


MANY = pytest.param(70, marks=pytest.mark.slow)


@pytest.mark.parametrize("n", [8, MANY])
@pytest.mark.parametrize("name", ["result.json", "failures.csv"])
def test_a_damaged_run_is_replayed_or_refused_in_one_line(name: str, n: int, run: Path) -> None:
    rng = np.random.default_rng(n)
    content = (run / name).read_bytes()
    assert_one_line(cli("replay", "run"), 0)
    for number in range(n):
        if number % 3 == 0:
            damaged = damage_bytes(content, rng)
        else:
            damaged = damage_json(content, rng, "question") if name == "result.json" else damage_table(content, rng)
        (run / name).write_bytes(damaged)
        assert_one_line(cli("replay", "run"), 0, 3)


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_damaged_blocks_are_one_line(number: int, run: Path) -> None:
    (run / "failures.npz").write_bytes(BLOCKS[number])
    refused = cli("replay", "run")
    assert_one_line(refused, *((0,) if number == len(HEADERS) + 3 else ()))  # an archive without blocks
    assert not Path("ran").exists()


@pytest.mark.parametrize("n", [6, pytest.param(40, marks=pytest.mark.slow)])
def test_a_damaged_journal_is_continued_or_refused_in_one_line(
    n: int, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "save_plot", lambda path, report: None)
    asked = Question(env_id=FOLLOWING, base="us101-gap", gamma=3.0, horizon=1.0, method="mc", max_sim=60)
    journal = begin_journal(run, asked)
    for _ in range(3):
        journal.append(JournalRecord("of other points", np.ones(20), {"reasons": [], "n_retried": 0}))
    journal.close()
    content = (run / JOURNAL).read_bytes()
    rng = np.random.default_rng(n)
    for _ in range(n):
        (run / JOURNAL).write_bytes(damage_bytes(content, rng))
        assert_one_line(cli("resume", "run"), 0, 3)


@pytest.mark.parametrize("n", [6, MANY])
def test_a_damaged_base_is_used_or_refused_in_one_line(n: int, tmp_path: Path, risky: str) -> None:
    rng = np.random.default_rng(n)
    content = Path(risky).read_bytes()
    base = tmp_path / "damaged.json"
    for number in range(n):
        base.write_bytes(damage_json(content, rng) if number % 3 else damage_bytes(content, rng))
        words = ("estimate", FOLLOWING, "--base", str(base), "--method", "mc", "--max-sim", "20", "--horizon", "0.5")
        assert_one_line(cli(*words), 0, 3)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([1], "an object with env_id"),
        ({}, "an object with env_id"),
        ({"env_id": FOLLOWING, "seed": 1.5}, "seed of the recorded question to be a whole number, got 1.5"),
        ({"env_id": FOLLOWING, "seed": True}, "seed of the recorded question to be a whole number, got True"),
        ({"env_id": FOLLOWING, "ego": None}, "ego of the recorded question to be a text"),
        ({"env_id": [FOLLOWING]}, "env_id of the recorded question to be a text"),
    ],
)
def test_what_is_no_question_is_refused(values: Any, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        read_question(values)


def test_a_recorded_question_comes_back_and_later_fields_are_left_out() -> None:
    asked = Question(env_id=FOLLOWING, noise="fixed", max_sim=10, gamma=1)
    assert read_question({**vars(asked), "a later field": 1}) == asked


def test_an_ego_that_sets_numpys_errors_sets_them_for_itself(here: Path, risky: str) -> None:
    (here / "strict.py").write_text(
        "import numpy as np, egos_here\n"
        "np.seterr(all='raise')\n"
        "class Strict(egos_here.Ego):\n"
        "    def choose(self, observation):\n"
        "        np.seterr(all='raise')\n"
        "        return np.zeros((len(observation), 2), np.float32)\n"
        "def make():\n"
        "    np.seterr(all='raise')\n"
        "    return Strict()\n"
    )
    before = np.geterr()
    words = ("--base", risky, "--max-sim", "2000", "--horizon", "2", "--gamma", "1", "--json")
    strict, usual = (cli("estimate", FOLLOWING, "--ego", ego, *words) for ego in ("strict:make", "egos_here:coasting"))
    assert strict.exit_code in (0, 3), strict.stderr
    assert json.loads(strict.stdout)["p"] == json.loads(usual.stdout)["p"]
    assert np.geterr() == before


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("name", ["result.json", "study.json", "failures.csv", "failures.npz", JOURNAL])
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
