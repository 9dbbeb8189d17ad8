"""EdgeGrasp in ROS 2: the node, and what it does as plain Python."""
