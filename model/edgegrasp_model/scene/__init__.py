"""From the cloud a caller sends to the scene that grasps are looked for in."""
