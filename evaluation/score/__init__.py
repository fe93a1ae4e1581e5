"""Scores in mm: error statistics, pixel sets, units, intervals, and scoring a folder of
predictions."""
