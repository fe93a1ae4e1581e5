"""Text of unknown origin (names in submissions, file names, JSON values): how it is checked and printed."""

import unicodedata

NAME_LIMIT = 200
"""Longest text a submission may hold in any one value, in characters."""

# Control, format (bidirectional overrides, zero-width), surrogate, and line or paragraph separators.
_FORBIDDEN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})


def text_problem(value: str, limit: int = NAME_LIMIT) -> str | None:
    """What is wrong with a one-line text, or None: empty, over ``limit`` characters, or with control characters."""
    if not value.strip():
        return "expected some text, got an empty one"
    if len(value) > limit:
        return f"expected at most {limit} characters, got {len(value)}"
    bad = next((c for c in value if unicodedata.category(c) in _FORBIDDEN), None)
    if bad is not None:
        return f"expected printable text, got the control character U+{ord(bad):04X}"
    return None


def printable(value: object, limit: int = NAME_LIMIT) -> str:
    """``value`` as text that is safe in a terminal: control characters escaped, cut at ``limit`` characters."""
    text = value if isinstance(value, str) else repr(value)
    escaped = "".join(
        c if unicodedata.category(c) not in _FORBIDDEN else c.encode("unicode_escape", "backslashreplace").decode()
        for c in text[:limit]
    )
    return escaped + ("..." if len(text) > limit else "")
