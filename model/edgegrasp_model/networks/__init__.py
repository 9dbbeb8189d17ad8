"""One file an architecture, and what they share."""
