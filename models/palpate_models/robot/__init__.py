"""Arm and table: kinematics, inertias, shapes."""
