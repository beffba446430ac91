"""The arm: kinematics, inertias, shape and table."""
