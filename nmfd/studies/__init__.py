"""Studies on the regional model: benchmark, robustness, scaling, ablations, bounds, and their pictures."""
