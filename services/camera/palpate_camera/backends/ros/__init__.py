"""A depth camera of a ROS 2 system in the role camera."""
