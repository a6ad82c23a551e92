"""Map and curves of live and finished runs."""
