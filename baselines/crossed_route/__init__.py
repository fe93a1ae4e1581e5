"""Absolute depth from a frame with two crossed fringes, measured; nothing learned (docs/crossed.md)."""
