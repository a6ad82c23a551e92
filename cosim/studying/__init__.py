"""From a SUMO configuration to an answer: `cosim study`."""
