"""Words for messages."""


def one_line(error: BaseException) -> str:
    """An exception as one line without a full stop."""
    words = " ".join(str(error).split()).rstrip(".")
    kind = type(error).__name__
    return f"{kind}: {words[:200]}" if words else kind
