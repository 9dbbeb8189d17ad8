"""What accepts requests, over HTTP and gRPC, and hands them to the workers unread."""
