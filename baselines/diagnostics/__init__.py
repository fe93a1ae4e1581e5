"""What did a model read, the fringes' phase or the object's shape: the paper's probes (Section 7), and more.

A `Subject` is what is diagnosed, a `Probe` asks it one question, a `Finding` is the answer; ``fpp-bench diagnose`` puts
them on one page. Importing this package imports neither numpy nor torch.
"""
