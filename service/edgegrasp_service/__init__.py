"""Grasp detection over HTTP and gRPC: one core, two thin transports."""

import os

# gRPC, which reads this as it is imported: the thread that waits for requests reads their bytes
# itself. Its event engine has them pass through three more threads, 0.2 ms of every request.
os.environ.setdefault("GRPC_EXPERIMENTS", "-event_engine_listener")
