"""The edgegrasp command line."""
