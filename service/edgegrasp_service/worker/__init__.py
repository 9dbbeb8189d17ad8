"""The worker processes: decode a request, detect, encode the answer."""
