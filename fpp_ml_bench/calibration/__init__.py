"""Calibration: the rig from captures of known shape, a board or a scene with known depth."""
