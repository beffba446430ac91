"""Studies: many examinations of drawn patients, on this machine or a cluster, and what is made of their results."""
