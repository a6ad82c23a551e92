"""Economic model predictive control."""
