"""Choices of what simulates, and reasons why torch has to."""

from collections.abc import Iterator
from contextlib import contextmanager

from rare_envs.plugins import one_line

CORES = ("auto", "torch", "numba")
"""Choices of what simulates."""


class NotCompiled(ValueError):
    """There is no compiled rollout; the message says why."""


class CompilerFails(NotCompiled):
    """numba is installed, but does not work here."""


def check_core(core: str) -> None:
    """Raise a ValueError if there is no such core.

    Example:
        >>> check_core("jax")
        Traceback (most recent call last):
            ...
        ValueError: Expected core to be one of 'auto', 'torch', 'numba', got 'jax'.
    """
    if core not in CORES:
        raise ValueError(f"Expected core to be one of {', '.join(map(repr, CORES))}, got {core!r}.")


@contextmanager
def compiler_failures() -> Iterator[None]:
    """Turn whatever is raised inside into `CompilerFails`.

    numba is imported and compiles at the first call, where anything may be raised.

    Example:
        >>> with compiler_failures():
        ...     raise OSError("disk full")
        Traceback (most recent call last):
            ...
        rare_envs.simulation.compiled.failures.CompilerFails: numba is installed, but fails here: OSError: disk full
    """
    try:
        yield
    except ImportError as error:
        raise CompilerFails(
            f"the compiled rollouts fail in this process: {error}; install 'rare-envs[driving]' wherever it is "
            "simulated, or make it with core='torch'"
        ) from error
    except Exception as error:
        raise CompilerFails(f"numba is installed, but fails here: {one_line(error)}") from error
