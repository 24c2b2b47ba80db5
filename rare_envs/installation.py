"""Installation: the libraries of the extra `driving`, without which only `samplers` works."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

DRIVING = (
    "cvxpy",
    "gymnasium",
    "highway_env",
    "jinja2",
    "matplotlib",
    "pettingzoo",
    "pyarrow",
    "stable_baselines3",
    "torch",
    "yaml",
)
"""Import names of what the extra `driving` installs (pyproject.toml)."""
_COMMAND = "rare-envs"


def find_missing_libraries(modules: tuple[str, ...] = DRIVING) -> tuple[str, ...]:
    """Return those of some libraries that are not installed; nothing is imported.

    Example:
        >>> find_missing_libraries(("torch", "car"))
        ('car',)
    """
    return tuple(name for name in modules if find_spec(name) is None)


def require_libraries(modules: tuple[str, ...] = DRIVING, what: str = "rare_envs, agents and training need") -> None:
    """Raise an error of one line that says what to install if a library is missing.

    Args:
        modules: Import names of the libraries; nothing is imported.
        what: Subject and verb of the line: what needs them.

    Raises:
        ImportError: If one is not installed.

    Example:
        >>> require_libraries()
        >>> require_libraries(("torch", "car"))
        Traceback (most recent call last):
            ...
        ImportError: rare_envs, agents and training need car, not installed: pip install 'rare-envs[driving]'.
    """
    missing = find_missing_libraries(modules)
    if missing:
        raise ImportError(f"{what} {', '.join(missing)}, not installed: pip install 'rare-envs[driving]'.")


def is_command_line() -> bool:
    """Return whether this process is the command `rare-envs`, `python -m rare_envs`, or a worker of one.

    A worker that is started anew has the arguments of its parent.

    Example:
        >>> is_command_line()
        False
    """
    program = Path(sys.argv[0]) if sys.argv else Path()
    if program == Path("-m"):  # the module is being looked for
        return "rare_envs" in sys.orig_argv[1:4]
    return program.stem == _COMMAND or program.parts[-2:] == ("rare_envs", "__main__.py")
