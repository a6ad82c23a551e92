"""The city to look at, live and afterwards."""
