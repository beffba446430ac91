"""Role perception: depth frames to a smooth surface and ordered palpation targets."""
