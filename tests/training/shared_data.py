"""The recorded traffic beside the repository, which some tests compare with and which is no part of it."""

from pathlib import Path

import pytest

DATA = Path(__file__).parents[3] / "shared" / "data"


def needs_data(*names: str) -> pytest.MarkDecorator:
    """Return a mark that skips a test where a file of the recorded traffic is absent."""
    absent = [name for name in names if not (DATA / name).is_file()]
    return pytest.mark.skipif(bool(absent), reason=f"recorded traffic is not part of the repository: no {absent}")
