"""Figures and HTML report of finished runs."""
