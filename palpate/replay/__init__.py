"""Replays a recording on the bus, and re-runs one service on its recorded inputs."""
