"""Files of I-24 MOTION, there and back: both carriageways, 25 Hz to 10 Hz, and what is refused."""

import json

import numpy as np
import pytest

from tests.training.data.published_files import CLOCK, WEST_END, i24_documents, write_i24
from tests.training.data.recordings import DT, FOOT, simulate
from training.data import columns
from training.data.formats import I24_EDGES, load_i24_motion
from training.data.road_axis import lanes_of
from training.data.table import NOBODY, find_leaders

ARRAYS = ("timestamp", "x_position", "y_position")


@pytest.fixture(scope="module")
def documents(traffic):
    return i24_documents(traffic)


def truth(traffic, table):
    """Simulated values at the rows of a table of every vehicle; x from the first step, y from the median."""
    seen = np.flatnonzero(traffic.inside(400.0)[::2].any(axis=0))
    k = np.rint((table.time - CLOCK) / DT).astype(int)
    i = seen[table.vehicle - 1]
    values = {name: getattr(traffic, name)[k, i] for name in ("x", "y", "speed")}
    return values | {"length": traffic.length[i], "width": traffic.width[i]}


@pytest.mark.parametrize(("direction", "name"), [(-1, "morning-west"), (1, "morning-east")])
def test_both_carriageways_become_the_road_frame(direction, name, traffic, tmp_path):
    table = load_i24_motion(write_i24(tmp_path / "morning.json", i24_documents(traffic, direction)))
    assert set(table.recording) == {name} == set(table.edges)
    values = truth(traffic, table)
    np.testing.assert_allclose(table.x - direction * WEST_END * FOOT, values["x"], atol=2e-3)
    np.testing.assert_allclose(table.y, values["y"] + 12.0 * FOOT, atol=2e-3)
    np.testing.assert_allclose(table.length, values["length"], atol=1e-9)
    np.testing.assert_allclose(table.width, values["width"], atol=1e-9)
    # slopes over 0.08 s, one-sided at the ends of a track, of a speed that changes by 6 m/s^2 at most
    np.testing.assert_allclose(table.speed, values["speed"], atol=0.15)
    assert np.isnan(table.acceleration).all()
    assert (table.lane == lanes_of(values["y"] + 12.0 * FOOT, I24_EDGES)).all() and table.lane.min() == 1
    row = find_leaders(table.frame, table.lane, table.x)
    assert (table.leader == np.where(row >= 0, table.vehicle[row], NOBODY)).all()


def test_carriageways_do_not_follow_each_other(traffic, tmp_path):
    both = i24_documents(traffic) + i24_documents(simulate(1, lanes=2, per_lane=6, seconds=10.0), 1, mark="e")
    table = load_i24_motion(write_i24(tmp_path / "m.json", both, indent=1))
    assert set(table.edges) == {"m-west", "m-east"}
    alone = load_i24_motion(write_i24(tmp_path / "m.json", both[: len(i24_documents(traffic))]))
    west = table.select(table.recording == "m-west")
    for name in ("vehicle", "frame", "x", "leader"):
        assert (west.column(name) == alone.column(name)).all()


def test_a_part_of_the_time_is_read(documents, tmp_path):
    path = write_i24(tmp_path / "morning.json", documents)
    whole, part = load_i24_motion(path), load_i24_motion(path, between=(CLOCK + 4.0, CLOCK + 8.0))
    assert (part.time.min(), part.time.max()) == pytest.approx((CLOCK + 4.0, CLOCK + 8.0))
    same = whole.select((whole.time > CLOCK + 3.99) & (whole.time < CLOCK + 8.01))
    assert (part.vehicle == same.vehicle).all()
    np.testing.assert_allclose(part.x, same.x, atol=2e-3)
    with pytest.raises(ValueError, match=r"morning.json has no rows between the times \(0, 1\)"):
        load_i24_motion(path, between=(0, 1))


def test_documents_longer_than_what_is_read_at_a_time(documents, tmp_path, monkeypatch):
    path = write_i24(tmp_path / "morning.json", documents, indent=2)
    whole = load_i24_motion(path)
    for chunk in (977, 100_003):
        monkeypatch.setattr(columns, "CHUNK", chunk)
        table = load_i24_motion(path)
        assert (table.x == whole.x).all() and (table.leader == whole.leader).all()


def test_a_hole_is_an_error_or_a_cut(documents, tmp_path):
    first = {name: documents[0][name][:30] + documents[0][name][60:] for name in ARRAYS}
    path = write_i24(tmp_path / "hole.json", [{**documents[0], **first}])
    with pytest.raises(ValueError, match=r"hole.json, document 1: vehicle 1 was missing for 30 frames before"):
        load_i24_motion(path)
    assert len(load_i24_motion(path, gaps="cut").track_starts()) == 2


def edit(documents, number, **fields):
    return [{**d, **fields} if i == number - 1 else d for i, d in enumerate(documents)]


def without(document, name):
    return {key: value for key, value in document.items() if key != name}


BROKEN = {
    "a field is missing": (lambda d: [d[0], without(d[1], "y_position")], r"document 2 lacks y_position; it has _id,"),
    "no identity": (lambda d: [without(d[0], "_id")], "document 1 lacks _id"),
    "an identity twice": (lambda d: [d[0], d[1], d[0]], "document 3: _id 6387.* was given before"),
    "ragged": (lambda d: edit(d, 2, x_position=d[1]["x_position"][1:]), r"document 2: expected arrays of one length"),
    "a word": (lambda d: edit(d, 2, length="long"), "document 2: expected numbers in length"),
    "lengths of every frame": (lambda d: edit(d, 2, length=[15.0, 15.0]), "document 2: expected numbers in length"),
    "null": (lambda d: edit(d, 2, width=None), "document 2: expected numbers in length"),
    "another direction": (lambda d: edit(d, 2, direction=0), "document 2: direction is 0, expected 1 or -1"),
    "against the direction": (
        lambda d: edit(d, 2, direction=1),
        "document 2: the vehicle moves against its direction, 1",
    ),
    "metres": (
        lambda d: [{**x, "length": x["length"] * FOOT, "width": x["width"] * FOOT} for x in d],
        r"median length of vehicles is 1\.\d+ m, .* in feet",
    ),
    "another rate": (
        lambda d: [{**x, **{name: x[name][::3] for name in ARRAYS}} for x in d],
        "times are 0.12 s apart, expected 0.04 s",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_documents_are_refused_by_their_number(name, documents, tmp_path):
    spoil, message = BROKEN[name]
    with pytest.raises(ValueError, match=message) as caught:
        load_i24_motion(write_i24(tmp_path / "broken.json", spoil(documents)))
    assert "broken.json" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no JSON array"),
        ("id,time\n1,2\n", "is no JSON array"),
        ('{"_id": 1}', "is no JSON array"),
        ("[]", "has no documents"),
        ("[1, 2]", "no array of JSON objects"),
        ("[", "ends within the array"),
        ('[{"_id": "a", "timestamp": [1.0, 2', "a document does not end"),
        ("[{_id: 1}]", "a document does not end"),
    ],
)
def test_other_files_are_refused(text, message, tmp_path):
    path = tmp_path / "odd.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message) as caught:
        load_i24_motion(path)
    assert "odd.json" in str(caught.value)
    path.write_bytes(b"[\xff\xfe")
    with pytest.raises(ValueError, match="Cannot read"):
        load_i24_motion(path)
    with pytest.raises(ValueError, match=r"Cannot read .*none\.json"):
        load_i24_motion(tmp_path / "none.json")


def test_a_truncated_file_is_refused(documents, tmp_path):
    text = json.dumps(documents)
    path = tmp_path / "cut.json"
    for end in (len(text) // 2, len(text) - 1):
        path.write_text(text[:end], encoding="utf-8")
        with pytest.raises(ValueError, match=r"cut\.json.*(ends within|does not end)|Cannot read .*cut\.json"):
            load_i24_motion(path)
