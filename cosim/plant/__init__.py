"""The city as a plant, and what acts in it."""
