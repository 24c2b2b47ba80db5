from __future__ import annotations

from rare_envs.exposure.rate import SOURCE_FIELDS, read_site, read_source


def test_a_record_that_says_nothing() -> None:
    assert read_source({}) == dict.fromkeys(SOURCE_FIELDS, "")
    assert read_site({}) == ""


def test_the_source_of_a_shipped_base_in_one_text() -> None:
    source = read_source({"source": "NGSIM, US 101", "licence": "CC BY-SA 3.0"})
    assert (source["data"], source["licence"]) == ("NGSIM, US 101", "CC BY-SA 3.0")


def test_a_site_comes_before_its_data() -> None:
    assert read_site({"source": {"site": "I-80", "data": "Coifman and Li"}}) == "I-80"
    assert read_site({"source": {"data": "Coifman and Li", "site": None}}) == "Coifman and Li"
