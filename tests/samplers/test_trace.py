from samplers.trace import Level, Status


def test_a_status_is_and_prints_as_its_word():
    assert [str(status) for status in Status] == ["converged", "no_hits", "budget", "stopped", "stalled"]
    assert f"{Status.BUDGET}" == "budget" == Status.BUDGET
    assert Status("stalled") is Status.STALLED


def test_a_level_belongs_to_the_first_run_and_has_no_chains_unless_it_says_so():
    level = Level(gamma=1.0, p=0.1, estimate=0.1, n_sim=50, n_points=50, cov=0.4)
    assert (level.run, level.acceptance, level.ess) == (0, None, None)
