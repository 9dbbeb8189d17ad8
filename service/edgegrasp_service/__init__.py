"""The grasp-detection server: one core, REST and gRPC transports."""
