"""The digest tells apart code, weights and base distributions."""

from __future__ import annotations

from pathlib import Path

import pytest

from rare_envs.study.execution import code_digest
from rare_envs.study.execution.code_digest import digest_code


def test_another_source_weight_or_base_is_other_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def digest(**files: str) -> str:
        for name, text in files.items():
            (tmp_path / name.replace("_", ".")).write_text(text)
        digest_code.cache_clear()
        return digest_code()

    shipped = digest()
    monkeypatch.setattr(code_digest, "_find_folder", lambda package: tmp_path)
    found = [digest(a_py="1"), digest(a_py="2"), digest(b_safetensors="w"), digest(c_json="{}"), digest(notes_txt="t")]
    digest_code.cache_clear()
    assert len({shipped, *found[:4]}) == 5
    assert found[4] == found[3]
