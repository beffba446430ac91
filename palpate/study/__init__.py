"""Studies: hundreds of examinations by one command, and what they say with intervals."""
