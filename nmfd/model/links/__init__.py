"""A plant of streets: a link transmission model with signals, gates, metering and drivers."""
