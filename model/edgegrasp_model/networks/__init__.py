"""One file per architecture, and what they share."""
