"""Compiled code is kept where it can be written, under a name that follows the sources."""

import os
import time

import numba
import pytest

from rare_envs.simulation.compiled import compilation


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    numba.config.reload_config()
    compilation.find_cache_folder.cache_clear()
    yield tmp_path
    compilation.find_cache_folder.cache_clear()


def double(value):
    return value + value


def test_code_is_kept_below_the_folder_that_was_asked_for(folder):
    before = numba.config.CACHE_DIR
    assert compilation.compiled(double)(2.0) == 4.0
    kept = list(folder.glob(f"compiled-{compilation.digest_sources()}/**/*double*.nbc"))
    assert len(kept) == 1
    assert before == numba.config.CACHE_DIR


def test_another_source_has_another_folder(folder, tmp_path, monkeypatch):
    (tmp_path / "one.py").write_text("LENGTH = 5.0\n")
    monkeypatch.setattr(compilation, "PACKAGE", tmp_path)
    first = compilation.digest_sources.__wrapped__()
    (tmp_path / "one.py").write_text("LENGTH = 4.0\n")
    assert compilation.digest_sources.__wrapped__() != first


def test_where_nothing_can_be_written_code_is_compiled_and_not_kept(folder, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert compilation.find_cache_folder() is None
    assert compilation.compiled(double)(3.0) == 6.0


def test_numba_that_is_switched_off_is_named(monkeypatch):
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    with pytest.raises(ImportError, match="NUMBA_DISABLE_JIT is set"):
        compilation.compiled(double)


def test_code_of_older_sources_is_removed_unless_it_was_used_within_a_week(tmp_path):
    now, names = time.time(), ("compiled-old", "compiled-recent", "compiled-kept", "other")
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "code.nbc").write_bytes(b"0")
    for name, days in (("compiled-old", 8), ("compiled-recent", 6), ("compiled-kept", 30), ("other", 30)):
        os.utime(tmp_path / name, (now - days * 86_400,) * 2)
    compilation.remove_old_code(tmp_path, tmp_path / "compiled-kept")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["compiled-kept", "compiled-recent", "other"]
    assert (tmp_path / "compiled-kept").stat().st_mtime > now - 60
