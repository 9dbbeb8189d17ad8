"""Clutter-removal trials in simulation."""
