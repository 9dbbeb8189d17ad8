"""Grasp detection over HTTP and gRPC: one core, two thin transports."""
