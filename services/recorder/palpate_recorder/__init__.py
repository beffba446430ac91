"""Recorder: every message of the bus into MCAP, readable by rosbags, Foxglove and ros2 bag."""
