"""Stiff and extreme cases: each against a reference of higher precision and the error that theory predicts."""
