"""The verbs of slip as a command of ROS 2."""
