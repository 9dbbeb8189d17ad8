"""Edge Grasp Network: networks, pipeline and weights."""
