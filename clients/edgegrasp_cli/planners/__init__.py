"""Planners for clutter-removal trials, and how the command line finds them."""
