"""Methods of other packages, found by entry point."""

import json
import re
import sys
import textwrap
import warnings

import pytest
from typer.testing import CliRunner

import samplers
from rare_envs.study.cli.app import app
from samplers.methods import ENTRY_POINT_GROUP, METHODS, Methods, get_method
from samplers.testing import check_method

LATTICE = """
    import dataclasses
    from typing import ClassVar

    import samplers
    from samplers.sample import binomial_cov


    @dataclasses.dataclass(frozen=True)
    class Lattice:
        '''Plain draws under another name.'''

        n: int = 2000

        name: ClassVar[str] = "lattice"
        stops_at_target: ClassVar[bool] = False

        def steps(self, inputs, goal, rng):
            n = min(self.n, goal.budget)
            f = yield inputs.base.sample(n, rng)
            hits = int((f <= goal.gamma).sum())
            level = samplers.methods.Level(
                gamma=goal.gamma, p=hits / n, estimate=hits / n, n_sim=n, n_points=n, cov=binomial_cov(hits / n, n)
            )
            return samplers.methods.Outcome.of_counts(hits, n, goal.confidence, (level,))


    class Nameless:
        def steps(self, inputs, goal, rng):
            yield


    class Sized(Lattice):
        def __init__(self, n):
            super().__init__(n)


    NUMBER, SMALL = 3, Lattice(n=50)
    """


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Pretend that a package with these entry points is installed; gives its folder."""

    def install(**entries):
        (tmp_path / "lattice_methods.py").write_text(textwrap.dedent(LATTICE))
        info = tmp_path / "lattice_methods-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lattice-methods\nVersion: 1.0\n")
        lines = [f"{name.replace('_', '-')} = {value}" for name, value in entries.items()]
        (info / "entry_points.txt").write_text("\n".join([f"[{ENTRY_POINT_GROUP}]", *lines]) + "\n")
        monkeypatch.syspath_prepend(tmp_path)
        return tmp_path

    vars(METHODS).pop("_all", None)  # as in a new process
    yield install
    vars(METHODS).pop("_all", None)
    sys.modules.pop("lattice_methods", None)


def fresh():
    """The registry as a new process sees it."""
    return Methods(*(METHODS[name] for name in METHODS.own))


def test_a_method_of_another_package_is_found(installed):
    installed(lattice="lattice_methods:Lattice")
    methods = fresh()
    assert list(methods) == [*METHODS.own, "lattice"]
    assert len(methods) == len(METHODS.own) + 1
    method = methods["lattice"](n=500)
    assert samplers.estimate(samplers.limit_states.half_space(2, 1.0).problem, method, seed=1).n_sim == 500
    check_method(methods["lattice"]())


def test_our_own_methods_do_not_import_others(installed):
    installed(lattice="lattice_methods:Lattice")
    methods = fresh()
    assert methods["mc"] is samplers.MonteCarlo
    assert "mc" in methods
    assert "lattice_methods" not in sys.modules
    assert "lattice" in methods


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("lattice", "no_such_module:Lattice", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("lattice", "lattice_methods:Lettuce", "AttributeError: .*Lettuce"),
        ("lattice", "lattice_methods:NUMBER", "expected a class, got 3"),
        ("lattice", "lattice_methods:Nameless", "class Nameless has no name, stops_at_target"),
        ("grid", "lattice_methods:Lattice", "class Lattice is named 'lattice', its entry point 'grid'"),
        ("mc", "lattice_methods:Lattice", "that name is taken"),
    ],
)
def test_one_that_cannot_be_used_is_named_and_left_out(installed, name, value, said):
    installed(**{name: value})
    methods = fresh()
    with pytest.warns(
        RuntimeWarning, match=rf"method '{name}' of lattice-methods \({value}\) cannot be used: .*{said}"
    ):
        assert list(methods) == METHODS.own
    assert methods["mc"] is samplers.MonteCarlo
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(methods) == METHODS.own  # said once


def test_a_method_is_named_by_its_place(installed):
    installed()
    problem = samplers.limit_states.half_space(2, 1.0).problem
    assert samplers.estimate(problem, "lattice_methods:Lattice", seed=1).n_sim == 2000
    assert samplers.estimate(problem, "lattice_methods:SMALL", seed=1).n_sim == 50
    assert [get_method(f"lattice_methods:{name}", n=7).n for name in ("Lattice", "SMALL", "Sized")] == [7, 7, 7]


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("no_such_module:Lattice", "No module named 'no_such_module'"),
        ("lattice_methods:Lettuce", "lattice_methods.*Lettuce"),
        ("lattice_methods:NUMBER", "expected a class, got 3"),
        ("lattice_methods:Nameless", "class Nameless has no name, stops_at_target"),
        ("lattice_methods:Sized", "Sized.__init__.* missing .*'n'; .* tuned = Sized\\(...\\)"),
        ("lattice_methods.Lattice", "Valid: auto, .*module:Class"),
    ],
)
def test_a_place_without_a_method_is_one_line(installed, place, said):
    installed()
    with pytest.raises(ValueError, match=f"^[^\n]*{place}[^\n]*{said}[^\n]*$"):
        get_method(place)
    refused = command_line("estimate", "CarFollowing", "--method", place)
    assert refused.exit_code == 2 and refused.stderr.count("\n") == 1 and re.search(said, refused.stderr)


def command_line(*words):
    return CliRunner().invoke(app, words)


@pytest.mark.slow
def test_the_command_line_knows_it(installed):
    installed(lattice="lattice_methods:Lattice", broken="lattice_methods:Lettuce")
    env = "rare_envs/CarFollowing-v0"
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        run = command_line("estimate", env, "--method", "lattice", "--json")
    assert "'broken' of lattice-methods" in run.stderr
    answer = json.loads(run.stdout)
    assert (answer["method"]["name"], answer["n_sim"]) == ("lattice", 2000)
    by_place = json.loads(command_line("estimate", env, "--method", "lattice_methods:SMALL", "--json").stdout)
    assert (by_place["method"]["name"], by_place["n_sim"]) == ("lattice", 50)
    assert "Plain draws under another name." in command_line("list", "methods").stdout
    assert "lattice" in command_line("list").stdout
    refused = command_line("estimate", env, "--method", "lattic")
    assert refused.exit_code == 2
    assert "Did you mean 'lattice'?" in refused.stderr
