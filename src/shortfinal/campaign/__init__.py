"""Monte Carlo over poses, errors and faults: how often the monitor errs, on one machine or a cluster."""
