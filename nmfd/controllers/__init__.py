"""Controllers with `reset` and `act`; `strategy.parse` makes them by name."""
