"""Fixtures of all tests."""

import os

os.umask(0o022)  # a .zip to which everybody may write is refused
