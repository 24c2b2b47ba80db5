"""Compiled code is kept where it can be written, under a name that follows the sources."""

import os
import time
from pathlib import Path

import numba
import numpy as np
import pytest

from rare_envs.compilation import machine_code
from rare_envs.simulation.compiled import tick_kernel


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    numba.config.reload_config()
    machine_code.find_cache_folder.cache_clear()
    yield tmp_path
    machine_code.find_cache_folder.cache_clear()


def double(value):
    return value + value


def double_all(values):
    return (values + values)[0]


def test_code_is_kept_below_the_folder_that_was_asked_for(folder):
    before = numba.config.CACHE_DIR
    assert machine_code.compiled(double)(2.0) == 4.0
    kept = list(folder.glob(f"compiled-{machine_code.digest_sources(Path(__file__))}/**/*double*.nbc"))
    assert len(kept) == 1
    assert before == numba.config.CACHE_DIR


def test_a_compiled_function_makes_no_arrays(folder):
    with pytest.raises(numba.core.errors.NumbaError, match="NRT required"):
        machine_code.compiled(double_all)(np.ones(2))


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package whose module `kernel` depends on all but `apart` and the folder's own `__init__`."""
    sources = {
        "__init__": "from rare_envs.apart import APART\n",
        "kernel": "from rare_envs.one import (\n    LENGTH,  # [m]\n)\n\n\ndef f():\n    import rare_envs.late\n",
        "one": "from rare_envs import two\nfrom rare_envs.parts import WIDTH\nLENGTH = 5.0\n",
        "two": "from rare_envs import kernel\n",  # a circle ends
        "parts/__init__": "from rare_envs.parts.deep import WIDTH\n",
        "parts/deep": "WIDTH = 2.0\n",
        "late": "",
        "apart": "",
    }
    folder = tmp_path / "rare_envs"
    (folder / "parts").mkdir(parents=True)
    for name, text in sources.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.setattr(machine_code, "PACKAGE", folder)
    return folder


def digest(folder):
    machine_code._find_imports.cache_clear()
    return machine_code.digest_sources(folder / "kernel.py")


@pytest.mark.parametrize("changed", ["kernel", "one", "two", "parts/__init__", "parts/deep", "late"])
def test_another_source_has_another_folder(package, changed):
    first, path = digest(package), package / f"{changed}.py"
    assert digest(package) == first
    path.write_text(path.read_text() + "HEIGHT = 1.0\n")
    assert digest(package) != first


@pytest.mark.parametrize("changed", ["__init__", "apart"])
def test_a_source_that_does_not_matter_leaves_the_folder(package, changed):
    first = digest(package)
    (package / f"{changed}.py").write_text("HEIGHT = 1.0\n")
    assert digest(package) == first


def test_a_kernel_depends_on_the_equations_and_constants_that_it_uses():
    root = machine_code.PACKAGE
    found = {path.relative_to(root).as_posix() for path in machine_code.find_sources(Path(tick_kernel.__file__))}
    assert found >= {
        "simulation/compiled/tick_kernel.py",
        "simulation/compiled/equations.py",
        "compilation/machine_code.py",
        "simulation/reward.py",
        "simulation/observation.py",
        "control/actions.py",
        "measures/base.py",
        "traffic/state.py",
    }
    assert not found & {"__init__.py", "envs/vector.py", "problem.py"}


def test_where_nothing_can_be_written_code_is_compiled_and_not_kept(folder, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert machine_code.find_cache_folder(Path(__file__)) is None
    assert machine_code.compiled(double)(3.0) == 6.0


def test_numba_that_is_switched_off_is_named(monkeypatch):
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    with pytest.raises(ImportError, match="NUMBA_DISABLE_JIT is set"):
        machine_code.compiled(double)


def test_code_of_older_sources_is_removed_unless_it_was_used_within_a_week(tmp_path):
    now, names = time.time(), ("compiled-old", "compiled-recent", "compiled-kept", "other")
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "code.nbc").write_bytes(b"0")
    for name, days in (("compiled-old", 8), ("compiled-recent", 6), ("compiled-kept", 30), ("other", 30)):
        os.utime(tmp_path / name, (now - days * 86_400,) * 2)
    machine_code.remove_old_code(tmp_path, tmp_path / "compiled-kept")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["compiled-kept", "compiled-recent", "other"]
    assert (tmp_path / "compiled-kept").stat().st_mtime > now - 60
