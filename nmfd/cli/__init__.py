"""The command line `nmfd`."""
