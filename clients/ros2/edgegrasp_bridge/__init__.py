"""EdgeGrasp in ROS 2: the node, and its logic in plain Python."""
