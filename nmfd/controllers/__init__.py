"""Controllers behind one `act(measurement)`; `registry` finds them by name."""
