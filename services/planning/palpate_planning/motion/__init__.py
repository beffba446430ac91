"""Arm motion: kinematics, collision scene, collision-free planning and time parametrisation."""
