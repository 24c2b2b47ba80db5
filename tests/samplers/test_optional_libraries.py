"""Optional libraries: only the one that is named is excused."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import samplers
from samplers.methods.blocks import project_mean
from samplers.problem import needs_library


def test_another_missing_module_is_an_error_of_its_own() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_part"), needs_library("numpy", "This test"):
        __import__("no_such_part")


def test_what_is_installed_is_imported() -> None:
    with needs_library("numpy", "This test"):
        import numpy as again
    assert again is np


@pytest.mark.parametrize("library", ["matplotlib", "pyarrow", "pandas", "cvxpy"])
def test_each_optional_library_is_named_with_what_installs_it(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    result = samplers.estimate(samplers.FunctionProblem(lambda u: u[:, 0], 1), "mc", seed=0, max_sim=10)
    use = {
        "matplotlib": result.plot,
        "pyarrow": result.to_arrow,
        "pandas": result.to_pandas,
        "cvxpy": lambda: project_mean(np.ones(2), np.zeros(2), np.array([[1.0, 0.0], [0.9, 0.4]]), 0.5),
    }[library]
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf"^.+ needs {library}: pip install {library}\.$"):
        use()
