"""A small network that averages a decoded depth over neighbours on the same surface, and fills pixels without one."""
