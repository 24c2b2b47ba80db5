"""Sources of scenes: kinds, and the part that is kept for tests."""

import dataclasses
from pathlib import Path

import pytest

from tests.training.data.formats.published_files import i24_documents, tgsim_rows, write_i24, write_tgsim
from tests.training.data.recordings import simulate, write_highd
from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.datasets import Source, load_scenes, split_end


@pytest.fixture(scope="module")
def highd(tmp_path_factory):
    folder = tmp_path_factory.mktemp("highd")
    write_highd(folder, simulate(seed=2, per_lane=6, seconds=16.0), simulate(seed=3, lanes=2, per_lane=6, seconds=16.0))
    return Source("highd", folder, recordings=("01",), seconds=4.0)


def test_the_end_of_each_recording_is_kept_for_tests():
    named = [dataclasses.replace(scenes(1)[0], name=f"{side}-{start}") for side in "ab" for start in range(10)]
    learn, test = split_end(named)
    assert [scene.name for scene in test] == ["a-8", "a-9", "b-8", "b-9"]
    assert len(learn) == 16
    assert split_end(named[:1])[1] == ()


def test_a_source_is_of_a_known_kind():
    with pytest.raises(ValueError, match="ngsim"):
        Source("waymo", Path("data"))


def test_a_source_of_another_format_is_learned_from(tmp_path):
    traffic = simulate(seed=2, per_lane=6, seconds=16.0)
    write_tgsim(tmp_path / "I294.csv", tgsim_rows(traffic))
    write_i24(tmp_path / "morning.json", i24_documents(traffic))
    for kind, name in (("tgsim", "I294.csv"), ("i24", "morning.json")):
        source = Source(kind, tmp_path / name, seconds=4.0)
        learn, test = load_scenes(source)
        assert len(learn) >= 2 and len(test) == 1
        assert source.options == f"--{kind} {name} --seconds 4"
        assert name.partition(".")[0] in source.description and source.licence


def test_both_directions_are_learned_from_and_their_ends_kept_for_tests(highd):
    learn, test = load_scenes(highd)
    sides = {scene.name.rsplit("-", 1)[0] for scene in learn}
    assert sides == {"01-upper", "01-lower"} == {scene.name.rsplit("-", 1)[0] for scene in test}
    for side in sides:
        ends = [[s for s in scenes if s.name.startswith(side)] for scenes in (learn, test)]
        assert max(scene.end for scene in ends[0]) < min(scene.start for scene in ends[1])
    assert {scene.name for scene in load_scenes(Source("highd", highd.path, seconds=4.0))[0]} == {s.name for s in learn}
