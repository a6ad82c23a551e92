"""Co-simulation: regional controllers in a SUMO city."""
