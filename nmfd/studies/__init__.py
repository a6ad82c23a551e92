"""Studies on the regional model: benchmark, robustness, bound, measured MFDs, and their
pictures."""
