"""Generated protocol of the grasp-detection service."""
