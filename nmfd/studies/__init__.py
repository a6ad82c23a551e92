"""Studies on the regional model, and their pictures."""
