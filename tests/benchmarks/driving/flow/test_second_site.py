import numpy as np
import pyarrow
import pyarrow.parquet
import torch

from benchmarks.driving.flow.recorded_flow import COIFMAN_FILE
from benchmarks.driving.flow.second_site import LANE_WIDTH, format_site, measure_site, read_windows
from benchmarks.driving.realism import rule_driver


def write_table(folder, frames=100):
    """Write three vehicles, 20 m apart at 10 m/s in lane 2; the last changes to lane 3 in the middle."""
    frame, vehicle = (each.ravel() for each in np.meshgrid(np.arange(frames), np.arange(1, 4)))
    lane = np.where((vehicle == 3) & (frame >= frames // 2), 3, 2)
    y_rear = 100.0 - 20.0 * vehicle + frame
    length = np.where(vehicle == 1, 6.0, np.nan)
    columns = {"vehicle": vehicle, "frame": frame, "lane": lane, "y_rear": y_rear, "length": length}
    columns["speed"] = np.full(len(frame), 10.0)
    pyarrow.parquet.write_table(pyarrow.table(columns), folder / COIFMAN_FILE)


def test_vehicles_begin_in_the_middle_of_their_lane(tmp_path):
    write_table(tmp_path)
    windows = read_windows(tmp_path, seconds=10.0)
    assert windows.x.shape[0] == 1
    assert windows.x.shape[2] == 4, "one that changes lanes is another one there"
    assert windows.length[0].tolist()[0] == 6.0
    inside = windows.present[0]
    torch.testing.assert_close(windows.y[0][inside].unique(), torch.tensor([1.5, 2.5]) * LANE_WIDTH)
    torch.testing.assert_close(windows.speed[0][inside], torch.full((int(inside.sum()),), 10.0), atol=1e-3, rtol=0.0)
    rows = measure_site(windows, {"IDM": [rule_driver]})
    assert rows["IDM"]["10 s"]["collision"] == 0.0
    assert "| IDM |" in format_site(rows)
