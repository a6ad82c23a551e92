"""Regional (NMFD) traffic model, controllers on it, and the closed loop."""
