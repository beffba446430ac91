"""The runs of this machine: how they are announced, found and operated from other terminals."""
