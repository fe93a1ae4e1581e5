"""Evaluation: scores of depth maps, checked predictions in, `result.json` out. The rules are in PROTOCOL.md."""
