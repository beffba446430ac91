"""Replay: a recording on the bus again, and one service again against what it was given."""
