"""Grasp detection over HTTP and gRPC: one core, two thin transports."""

import os

# gRPC reads this at import. Its default event engine passes requests through three more threads,
# which costs 0.2 ms each.
os.environ.setdefault("GRPC_EXPERIMENTS", "-event_engine_listener")
