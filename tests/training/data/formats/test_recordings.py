"""Recordings by kind: every format is read by the loader of its own."""

import pytest

from tests.training.data.formats.published_files import (
    CLOCK,
    coifman_matrix,
    i24_documents,
    tgsim_rows,
    write_coifman,
    write_i24,
    write_tgsim,
)
from training.data.formats.recordings import RECORDING_KINDS, load_recordings


def test_each_kind_is_read_by_its_loader(traffic, ngsim, highd, tmp_path):
    paths = {
        "ngsim": ngsim[0],
        "highd": highd[0],
        "tgsim": write_tgsim(tmp_path / "I294.csv", tgsim_rows(traffic)).parent,
        "i24": write_i24(tmp_path / "morning.json", i24_documents(traffic)),
        "coifman": write_coifman(tmp_path / "i80.mat", coifman_matrix(traffic)),
    }
    assert set(paths) == set(RECORDING_KINDS)
    found = {kind: {name for t in load_recordings(kind, path) for name in t.recording} for kind, path in paths.items()}
    assert found == {
        "ngsim": {"trajectories-us101"},
        "highd": {"01-lower", "01-upper"},
        "tgsim": {"I294-1-right"},
        "i24": {"morning-west"},
        "coifman": {"i80"},
    }
    (part,) = load_recordings("i24", paths["i24"], between=(CLOCK, CLOCK + 2.0))
    assert part.time.max() == pytest.approx(CLOCK + 2.0)
    assert len(list(load_recordings("highd", paths["highd"], recordings=("01",)))) == 1


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="Expected one of ngsim, highd, tgsim, i24, coifman, got 'waymo'"):
        next(load_recordings("waymo", "data"))
