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
    "typer",
    "yaml",
)
"""Import names of what the extra `driving` installs (pyproject.toml)."""
_COMMAND = "rare-envs"
_BAD_INPUT = 2
"""Exit code of the command line."""


def require_libraries(modules: tuple[str, ...] = DRIVING) -> None:
    """Raise an error of one line that says what to install if a library is missing.

    The console script `rare-envs` prints that line and exits with code 2 instead.

    Args:
        modules: Import names of the libraries; nothing is imported.

    Raises:
        ImportError: If one is not installed.

    Example:
        >>> require_libraries()
        >>> require_libraries(("torch", "car"))
        Traceback (most recent call last):
            ...
        ImportError: rare_envs, agents and training need car, not installed: pip install 'rare-envs[driving]'.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if not missing:
        return
    line = f"rare_envs, agents and training need {', '.join(missing)}, not installed: pip install 'rare-envs[driving]'."
    if sys.argv and Path(sys.argv[0]).stem == _COMMAND:
        print(line, file=sys.stderr)
        raise SystemExit(_BAD_INPUT)
    raise ImportError(line)
