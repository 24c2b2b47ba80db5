"""What a worker answers, and what it sends of errors that cannot be sent."""

import os
import subprocess
import sys

import pytest

from samplers.errors import EvaluationError
from samplers.execution.executors.worker import describe, make_portable, reply_to


class Odd(Exception):
    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


def test_errors_come_back_as_they_are_or_in_words():
    portable = make_portable(EvaluationError("no number"))
    assert type(portable) is EvaluationError
    assert str(portable) == "no number"
    odd = make_portable(Odd("a", "b"))  # pickled with one argument, it cannot be made again
    assert type(odd) is RuntimeError
    assert str(odd) == "Odd: a and b" == describe(Odd("a", "b"))


def test_an_exit_is_one_and_other_errors_are_answers():
    def compute(index, chunk):
        raise chunk

    assert str(reply_to(compute, (0,), ArithmeticError("off")).error) == "off"
    assert isinstance(reply_to(compute, (0,), KeyboardInterrupt()).error, KeyboardInterrupt)
    with pytest.raises(SystemExit):
        reply_to(compute, (0,), SystemExit(3))
    assert reply_to(lambda index, chunk: (index, chunk), (1,), "x").result == ((1,), "x")


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="the limit needs /proc")
def test_a_limit_of_memory_stays_below_one_that_is_set_already():
    code = """
import resource
from samplers.system import limit_memory
hard = 2**33
resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))
limit_memory(2**40)
print(resource.getrlimit(resource.RLIMIT_DATA) == (hard, hard))
limit_memory(2**20)
print(resource.getrlimit(resource.RLIMIT_DATA)[0] < 2**32)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]
