"""Methods of other packages, named by their place."""

import json
import re
import sys
import textwrap

import pytest
from typer.testing import CliRunner

import samplers
from rare_envs.study.cli.app import app
from samplers.methods import get_method

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
    """Put a module with methods in reach."""
    (tmp_path / "lattice_methods.py").write_text(textwrap.dedent(LATTICE))
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("lattice_methods", None)


@pytest.mark.usefixtures("installed")
def test_a_method_is_named_by_its_place():
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
@pytest.mark.usefixtures("installed")
def test_a_place_without_a_method_is_one_line(place, said):
    with pytest.raises(ValueError, match=f"^[^\n]*{place}[^\n]*{said}[^\n]*$"):
        get_method(place)
    refused = command_line("estimate", "CarFollowing", "--method", place)
    assert refused.exit_code == 2 and refused.stderr.count("\n") == 1 and re.search(said, refused.stderr)


def command_line(*words):
    return CliRunner().invoke(app, words)


@pytest.mark.slow
@pytest.mark.usefixtures("installed")
def test_the_command_line_takes_it():
    words = ("estimate", "rare_envs/CarFollowing-v0", "--method", "lattice_methods:SMALL", "--json")
    answer = json.loads(command_line(*words).stdout)
    assert (answer["method"]["name"], answer["n_sim"]) == ("lattice", 50)
