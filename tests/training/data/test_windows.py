"""Windows of a recording: they follow the record, meet where they were cut, and say what they need."""

import numpy as np
import pytest

from tests.training.data.recordings import cutting_in, simulate, write_ngsim
from training.data.formats.ngsim import load_ngsim
from training.data.trajectories import COLUMNS, tabulate
from training.data.windows import scenes_of


@pytest.fixture(scope="module")
def simulated():
    return simulate(0, lanes=3, per_lane=14, seconds=22.0, changers=0.8)


def test_scenes_follow_the_record_and_meet_where_they_were_cut(simulated, tmp_path):
    write_ngsim(tmp_path / "us101.csv", simulated)
    table = load_ngsim(tmp_path / "us101.csv")
    whole, *_ = scenes_of(table, seconds=1000.0)
    parts = scenes_of(table, seconds=4.0)
    first = parts[0]
    offset = round((first.start - whole.start) / 0.1)
    both = whole.present[offset : offset + len(first.x)]
    assert np.nansum(whole.x[offset : offset + len(first.x)][both]) == pytest.approx(np.nansum(first.x[first.present]))
    assert np.abs(np.sort(whole.speed[whole.present])).max() < 30.0


def test_what_scenes_need_is_named():
    table = cutting_in()
    columns = {name: table.column(name) for name in COLUMNS}
    with pytest.raises(ValueError, match=r"'r' has no lane boundaries.*y = 1\.8 to 5\.2 m.*lane 1 at 1\.8 m"):
        scenes_of(tabulate(columns))
    with pytest.raises(ValueError, match=r"nobody between its lane boundaries, -7 to 0 m; its vehicles are at y ="):
        scenes_of(tabulate(columns, {"r": (-7.0, -3.5, 0.0)}))
    with pytest.raises(ValueError, match="Scenes need width"):
        scenes_of(tabulate({name: table.column(name) for name in COLUMNS} | {"width": np.nan}))
    with pytest.raises(ValueError, match=r"scenes of 0\.4 s or more"):
        scenes_of(table, seconds=0.1)
