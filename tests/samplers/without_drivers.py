"""Estimates in a process that can import some packages and the standard library only.

Run by `test_alone.py`: `python without_drivers.py PACKAGES METHODS`, both joined by commas.
"""

import importlib.abc
import sys

allowed = {*sys.argv[1].split(","), "samplers"}


class OnlyAllowed(importlib.abc.MetaPathFinder):
    """Refuses every module that is neither allowed nor of the standard library."""

    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in allowed and top not in sys.stdlib_module_names and not top.startswith("_"):
            raise ModuleNotFoundError(f"No module named {name!r} (blocked)", name=name)


sys.meta_path.insert(0, OnlyAllowed())

import samplers  # noqa: E402 (after the blocker)

problem = samplers.FunctionProblem(lambda u: 3.0 - u.sum(axis=1) / 2.0, dim=4)
for method in sys.argv[2].split(","):
    result = samplers.estimate(problem, method, seed=0, max_sim=3000)
    print(method, result.p, result.n_sim)
