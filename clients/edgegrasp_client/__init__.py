"""Light client of the grasp-detection service, over gRPC or REST."""
