"""Any SUMO city -> networks/NAME and scenarios/NAME: `cosim import`."""
