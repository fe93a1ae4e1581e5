"""Calibration boards, photographed by the renderer's light: print, poses, and captures on disk."""
