"""Searches on simulated patients without an arm: trials of a policy and a Gymnasium environment."""
