"""What SUMO reads and writes; no control."""
