"""Start: version, libraries that must be installed, signals while modules are imported, and threads of torch.

Imported before everything else, so it imports nothing that is slow. The libraries are those of the extra `driving`,
without which only `samplers` works.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Iterator

TYPE_CHECKING = False  # as of typing, which takes longer than all the rest here
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any, NoReturn

DRIVING = (
    "cvxpy",
    "gymnasium",
    "highway_env",
    "jinja2",
    "matplotlib",
    "numba",
    "pettingzoo",
    "pyarrow",
    "stable_baselines3",
    "torch",
    "yaml",
)
"""Import names of what the extra `driving` installs (pyproject.toml)."""
_handlers: dict[int, Any] = {}
"""Handlers of signals in whose place `_end` stands."""


def find_missing_libraries(modules: tuple[str, ...] = DRIVING) -> tuple[str, ...]:
    """Return those of some libraries that are not installed; nothing is imported."""
    from importlib.util import find_spec  # some milliseconds, in which no signal is caught yet

    return tuple(name for name in modules if find_spec(name) is None)


def advise_install(extra: str) -> str:
    """Return the command that installs an extra of this package from where the package came from."""
    import json
    import shlex
    from importlib import metadata

    root, origin = os.path.dirname(os.path.dirname(os.path.abspath(__file__))), None
    if os.path.isfile(os.path.join(root, "pyproject.toml")):  # a clone
        return f"pip install -e {shlex.quote(f'{root}[{extra}]')}"
    with contextlib.suppress(metadata.PackageNotFoundError):
        origin = metadata.distribution("rare-envs").read_text("direct_url.json")  # not of those from an index
    found = json.loads(origin or "{}")
    vcs = found.get("vcs_info")
    source = f" @ {vcs['vcs']}+{found['url']}@{vcs['commit_id']}" if vcs else f" @ {found['url']}" if found else ""
    return f"pip install {shlex.quote(f'rare-envs[{extra}]{source}')}"


def require_libraries() -> None:
    """Raise an error of one line that says what to install if a library of `DRIVING` is missing."""
    missing = find_missing_libraries()
    if missing:
        names = ", ".join(missing)
        raise ImportError(f"rare_envs, agents and training need {names}, not installed: {advise_install('driving')}.")


def is_command_line() -> bool:
    """Return whether this process is the command `rare-envs`, `python -m rare_envs`, or a worker of one."""
    program = sys.argv[0] if sys.argv else ""
    if program == "-m":  # the module is being looked for
        return "rare_envs" in sys.orig_argv[1:4]
    folder, name = os.path.split(program)
    is_module = name == "__main__.py" and os.path.basename(folder) == "rare_envs"
    return is_module or os.path.splitext(name)[0] == "rare-envs"


def end_at_signals() -> None:
    """Let signals end a command in one line while modules are imported; Python would print where it was."""
    is_worker = "--multiprocessing-fork" in sys.orig_argv  # it imports the modules of its parent, and runs no command
    if is_worker or not is_command_line():
        return
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) not in (signal.SIG_IGN, _end, None):
            try:
                _handlers[number] = signal.signal(number, _end)
            except ValueError:  # not the main thread, which alone gets signals
                return


def restore_signals() -> None:
    """Set the handlers again that `end_at_signals` has replaced."""
    while _handlers:
        signal.signal(*_handlers.popitem())


def _end(number: int, frame: FrameType | None) -> NoReturn:
    """End the process, with the line and the exit code of a command that is stopped."""
    os.write(2, f"rare-envs: stopped by {signal.Signals(number).name}\n".encode())
    os._exit(128 + number)


__version__ = "0.1.0"


@contextlib.contextmanager
def use_one_thread() -> Iterator[None]:
    """Keep torch, if it is there, to one thread for a block or, as decorator, a function: sums then round alike."""
    if find_missing_libraries(("torch",)):
        yield
        return
    if "torch" not in sys.modules:
        end_at_signals()
    import torch  # here, because the command line shows its help without it

    restore_signals()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
