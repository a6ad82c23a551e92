"""The command line `cosim`."""
