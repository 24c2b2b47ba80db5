"""Runs in a process that has none of what only POSIX systems have, as on Windows; run by `test_platform_calls.py`.

`python without_posix.py FOLDER [WORDS]`: an estimate with a journal, or `rare-envs WORDS`.
"""

import importlib
import importlib.abc
import os
import signal
import subprocess  # noqa: F401  (the standard library makes itself at home on this system first)
import sys
import tempfile  # noqa: F401

POSIX_ONLY = {"fcntl", "resource", "pwd", "grp", "termios", "syslog"}
"""Modules that Windows does not have."""


class NoPosix(importlib.abc.MetaPathFinder):
    """Refuses the modules of POSIX_ONLY."""

    def find_spec(self, name, path=None, target=None):
        if name in POSIX_ONLY:
            raise ModuleNotFoundError(f"No module named {name!r} (blocked)", name=name)


folder, *words = sys.argv[1:]
for library in ("numpy", "scipy.stats", *(("torch", "highway_env", "pyarrow", "matplotlib.pyplot") if words else ())):
    importlib.import_module(library)  # the builds of others are those of this system
sys.meta_path.insert(0, NoPosix())
for name in POSIX_ONLY:
    sys.modules.pop(name, None)
for name in ("fork", "forkpty", "killpg", "getuid", "geteuid", "getpgid", "setsid"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGPIPE", "SIGALRM", "SIGUSR1", "pthread_sigmask"):
    if hasattr(signal, name):
        delattr(signal, name)

if words:
    from rare_envs.study.cli import main

    sys.argv = ["rare-envs", *words]
    os.chdir(folder)
    main()
else:
    import samplers

    problem = samplers.FunctionProblem(lambda u: 3.0 - u.sum(axis=1) / 2.0, dim=4)
    arguments = {"seed": 0, "max_sim": 2000, "journal": os.path.join(folder, "run.journal")}
    first = samplers.estimate(problem, "mc", **arguments)
    again = samplers.estimate(problem, "mc", **arguments)
    print(first.p == again.p, os.path.exists(arguments["journal"]))
