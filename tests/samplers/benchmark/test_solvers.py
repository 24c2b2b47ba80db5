"""Methods by name, and what is said of those that cannot be had."""

import importlib.util

import pytest

import samplers
from samplers.benchmark.solvers import NEEDED_MODULES, OTHER_SOLVERS, find_library_versions, find_method


@pytest.mark.parametrize(
    ("name", "said"),
    [("nothing", "Unknown method 'nothing'"), ("no.such:thing", "Cannot load the method"), ("math:pi", "got float")],
)
def test_what_is_no_method_is_refused(name, said):
    with pytest.raises(ValueError, match=said):
        find_method(name)


def test_ours_are_methods_and_those_of_a_user_are_what_they_wrote() -> None:
    assert isinstance(find_method("adss"), samplers.AdaptiveSubsetSimulation)
    assert isinstance(find_method("samplers:MonteCarlo"), samplers.MonteCarlo)
    assert find_method(f"{__name__}:guess") is guess


def guess(problem, seed, max_sim):
    return 1e-3, 0.0, 1.0


def test_versions_are_those_of_the_libraries_whose_methods_run() -> None:
    openturns = pytest.importorskip("openturns")
    assert find_library_versions(["mc", "openturns-ss", "openturns-ce"]) == {"openturns": openturns.__version__}
    assert find_library_versions(["two-stage", "module:uqpy"]) == {}


@pytest.mark.parametrize("name", OTHER_SOLVERS)
def test_a_library_that_is_missing_is_refused_with_what_installs_it(monkeypatch: pytest.MonkeyPatch, name) -> None:
    library = name.partition("-")[0]
    gone = NEEDED_MODULES[library][-1]
    real = importlib.util.find_spec
    found = {module: real("math") for modules in NEEDED_MODULES.values() for module in modules}
    monkeypatch.setattr("samplers.benchmark.solvers.find_spec", found.get)
    assert find_method(name) is OTHER_SOLVERS[name]
    del found[gone]
    with pytest.raises(ValueError, match=rf'needs the module {gone}: pip install "rare-envs\[{library}\]"'):
        find_method(name)
