"""The runs of this machine: announced by who starts them, found by tools and operators in other terminals."""
