"""Whether a model reads the fringe's phase or the object's shape: the paper's probes (Section 7)
and further ones."""
