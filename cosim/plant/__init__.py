"""The city as a plant, with its actuation and measurement."""
