"""JSON objects from text."""

import pytest

from rare_envs.files import parse_json_object


def test_an_object_comes_back():
    assert parse_json_object('{"a": [1, 2.5], "b": null}', "it") == {"a": [1, 2.5], "b": None}


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", "file.json is not valid JSON: .* line 1 column 2"), ("3", "file.json: expected a JSON object, got int")],
)
def test_other_texts_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_json_object(text, "file.json")
