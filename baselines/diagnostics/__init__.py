"""Whether a model reads the fringe's phase or the object's shape: the paper's probes (Section 7) and further ones.

A `Subject` is the model that is diagnosed, a `Probe` is one test of it, and a `Finding` is the probe's result;
``fpp-bench diagnose`` puts them on one page. Importing this package imports neither numpy nor torch.
"""
