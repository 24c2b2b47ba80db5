import math
import re

import pytest

import samplers
from samplers.estimation import show_bar
from samplers.limit_states import half_space
from samplers.run import Progress
from tests.samplers.conftest import QUICK_METHODS


@pytest.mark.parametrize("method", QUICK_METHODS)
def test_listener_is_told_of_simulations_levels_and_p(method):
    seen = []
    problem = half_space().problem
    result = samplers.estimate(problem, method, seed=1, max_sim=3000, progress=seen.append)
    counts = [progress.n_sim for progress in seen]
    assert counts == sorted(counts)
    assert counts[-1] == result.n_sim
    assert seen[0].max_sim == 3000
    assert math.isnan(seen[0].p)
    assert seen[-1].level == result.trace[-1].gamma
    assert seen[-1].p == pytest.approx(result.p)
    assert result == samplers.estimate(problem, method, seed=1, max_sim=3000)


def test_listener_knows_the_replicate():
    seen = []
    samplers.estimate(half_space().problem, "adss", seed=1, replicates=3, progress=seen.append)
    assert sorted({progress.run for progress in seen}) == [0, 1, 2]


def test_bar_goes_to_standard_error(capsys):
    result = samplers.estimate(half_space().problem, "adss", seed=1, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert f"{result.n_sim:,} simulations" in err
    assert f"P[f <= 0] = {result.p:.2e}" in err


def test_workers_and_both_times_fit_eighty_columns(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with show_bar(10_000) as show:
        show(Progress(n_sim=9_000, max_sim=10_000, level=0.0, p=1.2e-5, run=0, workers=12, seconds_left=70.0))
    last = capsys.readouterr().err.strip("\n").splitlines()[-1]
    assert len(last) <= 80 and re.search(r"\d:\d\d:\d\d$", last.strip())
    assert "9,000 done P[f <= 0] = 1.20e-05, 12 workers, 70 s left" in last  # all of it
    assert "retries" not in last


def failing_in_mid_run(x):
    if (x[:, 0] > 3.0).any():
        raise ArithmeticError("ego left the map")
    return 5.0 - x[:, 0]


def on_screen(written):
    """What a terminal shows after these characters, line by line."""
    lines, row, column = [""], 0, 0
    for part in re.findall(r"\x1b\[[0-9;?]*[a-zA-Z]|\r|\n|[^\x1b\r\n]+", written):
        if part == "\r":
            column = 0
        elif part == "\n":
            row, column = row + 1, 0
            lines += [""] * (row + 1 - len(lines))
        elif part == "\x1b[2K":
            lines[row] = ""
        elif part.startswith("\x1b["):
            row -= int(part[2:-1] or 1) if part.endswith("A") else 0
        else:
            lines[row] = lines[row][:column].ljust(column) + part + lines[row][column + len(part) :]
            column += len(part)
    return [line for line in lines if line.strip()]


@pytest.mark.parametrize("terminal", [False, True])
def test_bar_of_a_run_that_fails_leaves_nothing(capsys, monkeypatch, terminal):
    monkeypatch.setenv("TERM", "xterm")
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")  # rich then takes standard error for a terminal
    problem = samplers.FunctionProblem(failing_in_mid_run, 1)
    with pytest.raises(samplers.EvaluationError, match="ego left the map"):
        samplers.estimate(problem, samplers.MonteCarlo(batch=100), seed=1, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert ("simulations" in err) == terminal  # it was there
    assert on_screen(err) == []
    assert terminal or err == ""

    result = samplers.estimate(half_space().problem, "adss", seed=1, progress=True)
    assert f"{result.n_sim:,} simulations" in on_screen(capsys.readouterr().err)[0]
