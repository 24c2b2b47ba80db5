"""Fixtures of all tests."""

import functools
import os
import signal
import tempfile

import typer.testing
from hypothesis import settings

settings.register_profile("any-machine", deadline=None)  # on a busy one an example takes longer now and then
settings.load_profile("any-machine")
# a command line is built once, not at each of the hundreds of times that it is invoked
typer.testing._get_command = functools.cache(typer.testing._get_command)
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp()  # notes of runs that tests make
os.umask(0o022)  # a .zip to which everybody may write is refused
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell has it in the background; tests send it
    signal.signal(signal.SIGINT, signal.default_int_handler)
