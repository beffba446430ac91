"""Studies of search policies: comparison of all policies, training of the learned one, the prior, speed and film."""
