"""Absolute depth from one frame with two crossed fringes; nothing is learned (docs/phase_and_order.md)."""
