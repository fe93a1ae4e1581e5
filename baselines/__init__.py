"""Methods that turn fringes into depth, and running them over a dataset.

A method takes the frames it names and gives ``depth_mm``; `fpp_ml_bench.baselines.methods` lists what there is, and
`fpp_ml_bench.baselines.prediction` runs one over a split and writes predictions that ``fpp-eval`` scores.
"""
