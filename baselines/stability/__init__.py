"""Ill-conditioned and extreme cases, each compared with a reference of higher precision and a
theoretical bound."""
