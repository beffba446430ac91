"""The soft abdomen as a linear elastic solid: another implementation of the role `tissue`. See the README for its equations."""
