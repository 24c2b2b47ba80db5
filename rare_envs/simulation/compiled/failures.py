"""Reasons why torch has to simulate."""

from collections.abc import Iterator
from contextlib import contextmanager

from rare_envs.plugins import one_line


class NotCompiled(ValueError):
    """There is no compiled rollout; the message says why."""


class CompilerFails(NotCompiled):
    """numba is installed, but does not work here."""


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
            f"the compiled rollouts fail in this process: {error}; install 'rare-envs[fast]' wherever it is "
            "simulated, or make it with core='torch'"
        ) from error
    except Exception as error:
        raise CompilerFails(f"numba is installed, but fails here: {one_line(error)}") from error
