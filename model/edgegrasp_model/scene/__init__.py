"""From the caller's cloud to the scene in which grasps are searched."""
