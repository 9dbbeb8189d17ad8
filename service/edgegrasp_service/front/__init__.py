"""The front: accepts requests over HTTP and gRPC and passes them to the workers undecoded."""
