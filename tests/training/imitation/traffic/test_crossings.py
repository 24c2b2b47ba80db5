from tests.training.imitation.synthetic_scenes import CROSSING, crossing_recording
from training.imitation.traffic.crossings import find_crossings


def test_a_crossing_is_found_where_it_is():
    recording = crossing_recording()
    found = find_crossings(recording)
    assert [column.tolist() for column in found] == [[1], [CROSSING], [0], [1]]
    y = recording.y.clone()
    y[1, CROSSING + 4 :, 0] = 1.8
    assert len(find_crossings(recording._replace(y=y)).scene) == 0  # back again before it has settled
