"""What numba raises comes back as one line that says what to do."""

import pytest

from rare_envs.simulation.compiled.failures import CompilerFails, NotCompiled, compiler_failures


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ImportError("No module named 'numba'"), "install 'rare-envs\\[driving\\]' wherever it is simulated"),
        (RuntimeError("no\nspace"), "fails here: RuntimeError: no space$"),
    ],
)
def test_errors_inside_become_one_line(error, line):
    with pytest.raises(CompilerFails, match=line) as raised, compiler_failures():
        raise error
    assert "\n" not in str(raised.value) and isinstance(raised.value, NotCompiled)


def test_nothing_happens_where_nothing_fails():
    with compiler_failures():
        value = 1
    assert value == 1
