"""The regional model (NMFD) and everything that follows from it alone."""
