"""Fixtures of all tests."""

import os
import tempfile

os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp()  # notes of runs that tests make
os.umask(0o022)  # a .zip to which everybody may write is refused
