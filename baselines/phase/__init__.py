"""Depth through wrapped phase and fringe order, from one frame: what the rig knows is computed,
never learned."""
