"""Reproducing the paper's tables: which trainings fill their rows, training, and scoring. Reading
and writing rows of the leaderboard is handed in."""
