"""Plans from a result that anybody may have written, and from pilots."""

from __future__ import annotations
