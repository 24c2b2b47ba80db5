"""Generators of two-stage, driven."""


def driven(steps, problem):
    """Answer a generator that yields points with their outcomes, if it does; return what it returns."""
    try:
        u = next(steps)
        while True:
            u = steps.send(problem.evaluate(u))
    except StopIteration as end:
        return end.value
