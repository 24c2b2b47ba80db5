"""Files that are damaged, by chance or on purpose, are one line, and never a traceback."""

from __future__ import annotations

import io
import json
import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rare_envs.study.run_folder import JOURNAL
from tests.rare_envs.study.test_damaged_kinds import FOLLOWING, assert_one_line, cli


def npz(**entries: bytes) -> bytes:
    """Return an .npz whose entries are these bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def npy(header: str, version: bytes = b"\x01\x00") -> bytes:
    size = len(header).to_bytes(2 if version == b"\x01\x00" else 4, "little")
    return b"\x93NUMPY" + version + size + header.encode()


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


@pytest.fixture
def run(finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it to damage, in the working directory."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_damaged_blocks_are_one_line(number: int, run: Path) -> None:
    (run / "failures.npz").write_bytes(BLOCKS[number])
    refused = cli("replay", "run")
    assert_one_line(refused, *((0,) if number == len(HEADERS) + 3 else ()))  # an archive without blocks
    assert not Path("ran").exists()


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
