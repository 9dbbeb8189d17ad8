"""What runs in the worker processes: decode a request, detect, encode the answer."""
