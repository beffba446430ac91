"""Role camera: a Kinect-like depth camera, by ray casting."""
