from __future__ import annotations

from pathlib import Path

import pytest

from rare_envs.study.run_folder import DIGESTED, digest_results, find_changed_results


@pytest.fixture
def run(tmp_path: Path) -> Path:
    for name in DIGESTED[:3]:
        (tmp_path / name).write_text(name * 200_000)  # longer than a block
    return tmp_path


def test_every_bit_counts(run: Path) -> None:
    written = {"results": digest_results(run)}
    assert set(written["results"]) == set(DIGESTED[:3])
    assert find_changed_results(run, written) == []
    content = bytearray((run / DIGESTED[1]).read_bytes())
    content[-1] ^= 1
    (run / DIGESTED[1]).write_bytes(content)
    assert find_changed_results(run, written) == [DIGESTED[1]]
