"""The soft abdomen: role `tissue`. See the README for its equations."""
