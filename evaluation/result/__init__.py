"""``result.json``: its strict model, its checks, and what it was computed with."""
