"""highD folders, there and back: both directions in the frame of the road, and what is refused."""

import numpy as np
import pytest

from tests.training.data.recordings import DT, LANE, ROAD, change, check_values, expected, write_csv
from training.data.formats import highd_recordings, load_highd
from training.data.table import NOBODY


def spoiled(folder, rows, tmp_path, file="tracks", **texts):
    for path in folder.iterdir():
        (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    if file == "tracks":
        write_csv(tmp_path / "01_tracks.csv", rows)
    else:
        path = tmp_path / f"01_{file}.csv"
        text = path.read_text(encoding="utf-8")
        for old, new in texts.items():
            text = text.replace(old, new)
        path.write_text(text, encoding="utf-8")
    return tmp_path


def test_highd_turns_both_directions_into_the_road_frame(traffic, highd):
    folder, rows, lower = highd
    assert highd_recordings(folder) == ("01",)
    table = load_highd(folder, "01")
    assert set(table.recording) == {"01-upper", "01-lower"}
    for side, simulated, first in (("upper", traffic, 1), ("lower", lower, 25)):
        part = table.select(table.recording == f"01-{side}")
        # time 0.04 s is the first frame, which was simulated at 0 s
        at = 5 * part.frame - 2
        values = expected(simulated, part, at, first)
        # the upper lanes are turned about the origin, so x ends where the picture begins
        i = part.vehicle - first
        across = (simulated.y[np.minimum(at + 1, len(simulated.y) - 1), i] - simulated.y[at, i]) / DT
        # between frames of 0.04 s, that is at odd steps, speeds are interpolated
        odd = at % 2
        values["speed"] = np.hypot(0.5 * (simulated.speed[at - odd, i] + simulated.speed[at + odd, i]), across)
        values["y"] = values["y"] + part.edges[f"01-{side}"][0]
        check_values(part, values, x_offset=-ROAD if side == "upper" else 0.0, atol=0.02)
        np.testing.assert_allclose(np.diff(part.edges[f"01-{side}"]), LANE)
        assert (part.lane == values["lane"]).mean() > 0.999
        assert (part.leader == NOBODY).any()
        known = part.find_rows(part.leader) >= 0
        assert (part.x[part.find_rows(part.leader)[known]] > part.x[known]).all()
    assert (np.abs(np.diff(table.frame[table.vehicle == table.vehicle[0]])) == 1).all()
    assert len(table) < len(rows) / 2.4


def test_broken_highd_folders_are_refused(highd, tmp_path):
    folder, rows, _ = highd
    km_h = [{**row, "xVelocity": 3.6 * row["xVelocity"]} for row in rows]
    around = [{**row, "xVelocity": -row["xVelocity"]} for row in rows]
    for broken, message in (
        (rows[:30] + rows[33:], r"01_tracks\.csv, line 32: vehicle \d+ was missing for 3 frames"),
        ([*rows, rows[0]], r"01_tracks\.csv, line \d+: vehicle \d+ at frame \d+ is given twice, first in line 2"),
        (km_h, r"01_tracks\.csv, line \d+: "),
        (around, "against its drivingDirection"),
        (change(rows, 0, id=999), "line 2: vehicle 999 is not in the file of tracksMeta"),
        ([{k: v for k, v in row.items() if k != "precedingId"} for row in rows], "lacks the columns precedingId"),
    ):
        with pytest.raises(ValueError, match=message):
            load_highd(spoiled(folder, broken, tmp_path), "01")
    for file, texts, message in (
        ("recordingMeta", {"1,25,": "1,5,"}, r"01_recordingMeta\.csv, line 2: frameRate is 5"),
        ("recordingMeta", {"11.75;": "banana;"}, "separated by semicolons"),
        ("tracksMeta", {"Car,1": "Car,3"}, r"01_tracksMeta\.csv, line 2: drivingDirection is 3"),
    ):
        with pytest.raises(ValueError, match=message):
            load_highd(spoiled(folder, rows, tmp_path, file, **texts), "01")
    with pytest.raises(ValueError, match=r"There is no folder .*none; expected the data folder of highD"):
        highd_recordings(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="is it the data folder of highD"):
        highd_recordings(tmp_path / "empty")
