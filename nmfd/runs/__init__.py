"""Runs on disk: folders, files, configuration, worker processes."""
