"""edgegrasp.oip: protobuf messages and gRPC stubs of the Open Inference Protocol."""
