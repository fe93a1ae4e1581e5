"""The published layout (PNG + .mat): reading it into the dataset format, and writing it."""
