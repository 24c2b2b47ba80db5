"""The runs, their summary and the command, on small budgets."""

import json
from dataclasses import replace

from typer.testing import CliRunner

import benchmarks.estimators.compare_methods
from benchmarks.estimators.report import format_cells, summary
from benchmarks.estimators.targets import verdicts
from samplers.benchmark.runs import Job, run_all
from samplers.benchmark.summary import cell_of, cells_of, covers, power_of
from tests.samplers.benchmark.test_summary import P, made


def test_targets():
    good = cell_of([made(0.98 * P, 0.03)] * 5 + [made(1.03 * P, 0.03)] * 5, P)
    nothing = power_of([])
    of_papers = verdicts([good], nothing)
    assert [verdict.met for verdict in of_papers] == [True]
    default = verdicts([replace(good, method="two-stage", gain=5000.0)], nothing)
    assert {v.target: v.met for v in default} == {
        "lin_d2: gain >= 3,000": True,
        "lin_d2: coverage >= 88%": True,
        "lin_d2: mean/p within 3 %": True,
        "lin_d2: own c.o.v. 0.8 to 1.3 of the real one": True,
        "pooled coverage >= 93%": True,
        "wrong runs warned >= 80 %": True,
        "right runs warned <= 5 %": True,
    }
    bad = replace(good, method="two-stage", gain=2000.0, mean_over_p=0.96, coverage=0.8, own_over_cov=0.5)
    assert sum(verdict.met for verdict in verdicts([bad], nothing)) == 2


def test_tables():
    jobs = [Job("ce", "lin_d2", seed, 3000) for seed in range(3)]
    runs = list(run_all(jobs))
    cells = cells_of(runs)
    assert all(covers(run, 2.326e-4) for run in runs)
    text = format_cells(cells)
    assert len({line.count("|") for line in text.splitlines()}) == 1
    assert "Pooled coverage 100.0 % of 3 runs" in summary(cells, power_of(runs), verdicts(cells, power_of(runs)))


def test_command(tmp_path):
    out = tmp_path / "figures.json"
    app = benchmarks.estimators.compare_methods.typer.Typer()
    app.command()(benchmarks.estimators.compare_methods.main)
    arguments = "--runs 2 --methods adss --problems corner_d5,never_d4 --max-sim 1000 --rotation 7 --json".split()
    result = CliRunner().invoke(app, [*arguments, str(out)])
    assert result.exit_code == 0, result.output
    assert "corner_d5" in result.output
    data = json.loads(out.read_text())
    assert data["about"]["rotation"] == 7
    assert len(data["runs"]) == 4
    assert max(run["n_sim"] for run in data["runs"]) <= 1000
    unknown = CliRunner().invoke(app, ["--problems", "corner"])
    assert unknown.exit_code == 2
