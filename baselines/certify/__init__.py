"""A simulated type test of a method on a rig: gauges, acceptance quantities, a certificate."""
