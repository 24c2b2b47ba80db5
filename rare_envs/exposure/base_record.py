"""Record of a base distribution: site, data and licence of the recordings that its events come from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SOURCE_FIELDS = ("site", "date", "data", "licence")


def read_source(record: Mapping[str, Any]) -> dict[str, str]:
    """Return what a record says of its source, in `SOURCE_FIELDS`; empty texts where it says nothing.

    Args:
        record: The provenance of a base distribution: its entries, or those of its `source`, are read.

    Example:
        >>> read_source({"source": {"site": "US 101", "data": "NGSIM"}, "licence": "CC BY-SA 3.0"})
        {'site': 'US 101', 'date': '', 'data': 'NGSIM', 'licence': 'CC BY-SA 3.0'}
        >>> read_source({"source": "NGSIM, US 101"})["data"]
        'NGSIM, US 101'
    """
    source = record.get("source", {})
    inner = source if isinstance(source, Mapping) else {"data": source}
    return {name: str(inner.get(name, record.get(name, "")) or "") for name in SOURCE_FIELDS}


def read_site(record: Mapping[str, Any]) -> str:
    """Return the site of a record, or its data where no site is named; empty if neither is.

    Example:
        >>> read_site({"source": {"site": "I-80, Emeryville", "data": "Coifman and Li"}})
        'I-80, Emeryville'
    """
    source = read_source(record)
    return source["site"] or source["data"]


def explain_no_frequency(record: Mapping[str, Any]) -> str:
    """Return why the events of a base distribution have no frequency.

    Example:
        >>> explain_no_frequency({})
        'nobody counted how often its events happen'
        >>> explain_no_frequency({"source": {"site": "US 101", "no_frequency": "its pairs were under way"}})
        'its pairs were under way'
    """
    source = record.get("source", {})
    reason = source.get("no_frequency") if isinstance(source, Mapping) else None
    return str(reason or "nobody counted how often its events happen")
