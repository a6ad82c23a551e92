"""Plant of streets: link transmission, signals, gates and drivers."""
