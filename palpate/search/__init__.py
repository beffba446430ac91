"""Searches on patients without an arm: trials of a policy, an environment to learn in, the study of all policies, the film."""
