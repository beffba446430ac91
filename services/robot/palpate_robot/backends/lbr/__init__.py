"""A real KUKA LBR in the role robot, through lbr_fri_ros2_stack over rmw_zenoh, and an emulator that stands in for it."""
