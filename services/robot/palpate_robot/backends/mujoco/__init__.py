"""LBR iiwa 7 R800 simulated in MuJoCo: an independent plant for the role robot."""
