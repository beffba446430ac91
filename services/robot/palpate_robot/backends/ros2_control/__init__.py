"""Arms behind ros2_control in the role robot: the driver, profiles of two stacks, and an emulator of both."""
