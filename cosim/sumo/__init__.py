"""Files and sessions of SUMO; no control."""
