"""A simulated Kinect: ray casting of the deformed abdomen with a published noise model."""
