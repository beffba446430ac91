"""Searches on patients under the hand: trials of a policy, an environment to learn in, the study of all policies, the film."""
