"""Captured images: reading the frames of a scan, and writing what was decoded from them."""
