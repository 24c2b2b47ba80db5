from samplers.trace import Level, Status, describe_outcome


def test_a_status_is_and_prints_as_its_word():
    assert [str(status) for status in Status] == ["converged", "no_hits", "budget", "stopped", "stalled"]
    assert f"{Status.BUDGET}" == "budget" == Status.BUDGET
    assert Status("stalled") is Status.STALLED


def test_a_level_belongs_to_the_first_run_and_has_no_chains_unless_it_says_so():
    level = Level(gamma=1.0, p=0.1, estimate=0.1, n_sim=50, n_points=50, cov=0.4)
    assert (level.run, level.acceptance, level.ess) == (0, None, None)


def test_converged_does_not_stand_beside_warnings():
    assert describe_outcome(Status.CONVERGED, ()) == "converged"
    assert describe_outcome(Status.CONVERGED, ("a", "b")) == "came to its end with 2 warnings"
    assert describe_outcome(Status.STALLED, ("a",)) == describe_outcome("stalled", ()) == "stalled"
