"""Error against run time and captured frames: measuring every setting, and the picture of error
against a cost."""
