"""One file per architecture, and shared parts."""
