"""From a scene to the hands that the network scores."""
