"""Leaderboard: result files ranked by group, and the paper's own rows beside them."""
